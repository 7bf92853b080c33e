"""The project's own shape: packages from one folder, commands that answer, documents that name what exists."""

import importlib
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PACKAGES = ("capture", "process", "reconstruct", "hw_sim")


def test_the_four_packages_come_from_this_checkout():
    """Their names are plain enough to be shadowed by a stray script or another distribution."""
    folders = {Path(str(importlib.import_module(name).__file__)).parent for name in PACKAGES}
    assert folders == {ROOT / name for name in PACKAGES}


def test_the_recorder_loads_neither_cv2_nor_scipy():
    """The daemon must start in a second and stay small; what looks at pictures runs elsewhere."""
    heavy = ("cv2", "scipy", "pyarrow")
    code = f"import sys, capture.cli, capture.daemon; print([m for m in {heavy} if m in sys.modules])"
    answer = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert answer.stdout.strip() == "[]"


@pytest.mark.parametrize("package", PACKAGES)
def test_each_command_helps_and_refuses(package):
    code = f"from {package}.cli import main; main()"
    assert subprocess.run([sys.executable, "-c", code, "--help"], capture_output=True).returncode == 0
    wrong = subprocess.run([sys.executable, "-c", code, "--no-such-option"], capture_output=True, text=True)
    assert wrong.returncode == 2
    assert "Traceback" not in wrong.stderr
