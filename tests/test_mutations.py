"""What `python -m mutations` takes out of the code is in the code."""

from mutations import MUTATIONS, ROOT


def test_each_guard_is_found_once() -> None:
    lost = [
        f"{x.file}: {x.guard}" for x in MUTATIONS if (ROOT / x.file).read_text().count(x.old) != 1
    ]
    assert not lost
