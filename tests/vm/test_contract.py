"""The camera contract on a real kernel's USB and V4L2: the suite of tests/capture/camera_contract, run in a guest."""

import pytest
from camera_harness import IN_THE_VM
from vm import CHECKOUT, START_UDEV, run_in_vm

pytestmark = pytest.mark.slow


def test_backends_keep_the_contract_on_a_real_kernel(tmp_path):
    script = f"""{START_UDEV}
cd {CHECKOUT}
export WINGSHAPE_NO_SKIP=1 WINGSHAPE_HARNESSES={",".join(IN_THE_VM)}
python -m pytest -p no:cacheprovider -q --tb=short tests/capture/camera_contract
"""
    run = run_in_vm(script, tmp_path, ["vhci-hcd"], timeout_s=200)
    assert "passed" in run.output
