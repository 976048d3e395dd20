"""The server of the page starts, or says why it cannot."""

import pytest

from manifeel_ms3.errors import InvalidArgumentError, MachineError
from manifeel_ms3.teleop import __main__ as teleop
from tests.tasks_and_marks import PEG

pytest.importorskip("viser")


def test_a_host_of_another_machine_is_refused():
    from manifeel_ms3.teleop.local_server import LocalServer

    with pytest.raises(MachineError, match=r"cannot listen on the host '203\.0\.113\.5' \(.+\); give one of its own addresses"):
        LocalServer("203.0.113.5", 0, "page")  # an address that is reserved for documentation (RFC 5737)


@pytest.mark.parametrize("port", [-1, 0, 65536])
def test_a_number_that_is_no_port_is_refused(port):
    with pytest.raises(InvalidArgumentError, match=f"--port {port} is not a port; give a number from 1 to 65535"):
        teleop.main(teleop.Args(PEG, port=port))
