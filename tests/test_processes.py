"""Several processes joined by `jax.distributed`."""

import subprocess
import sys
from pathlib import Path
from unittest import mock

import jax
import numpy as np
import pytest

import fitting
import jaxhair as jh

SCALE_OUT = Path(__file__).parent / "benchmarks" / "scale_out.py"


def test_two_processes_with_two_devices_change_nothing() -> None:
    """The command compares a fit and a film to 1e-6, of strands that share out unevenly."""
    command = [sys.executable, str(SCALE_OUT), "--processes", "2", "--devices", "2"]
    done = subprocess.run(
        [*command, "--strands", "19"], capture_output=True, text=True, timeout=600
    )
    assert done.returncode == 0, done.stderr
    assert "numbers: at most" in done.stdout
    assert "film: at most" in done.stdout


def test_what_processes_cannot_do_is_refused(tmp_path: Path) -> None:
    hair = jh.Strands.straight(np.zeros((2, 3)), (1, 0, 0), length=0.1, points=5)
    scene = jh.Scene(hair, phases=(jh.Phase("fall", 0.01, (jh.Gravity(), jh.Hold())),))
    targets = {"fall": fitting.Shape(np.zeros((2, 5, 3)))}
    free = {"fibre.stiffness": fitting.Interval(0.0, 0.5)}
    with mock.patch.object(jax, "process_count", return_value=2):
        with pytest.raises(ValueError, match=r"checkpoint is .*several processes"):
            fitting.fit_each(scene, targets, free, checkpoint=tmp_path / "kept")
        with (
            mock.patch.object(jax, "devices", return_value=4 * jax.local_devices()),
            pytest.raises(ValueError, match=r"devices is 2; with 2 processes it must be 1.* or 4"),
        ):
            jh.run(scene, devices=2)
