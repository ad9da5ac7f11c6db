"""Alembic files (.abc) of hair, without Alembic's library: no maintained Python package has it.

From the bytes upwards: ogawa.py, the container; archive_writing.py, headers.py and
archive_reading.py, objects and properties in it; writing.py and reading.py, hair.
"""

from jaxhair.alembic.writing import write

__all__ = ["write"]
