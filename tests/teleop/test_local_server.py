"""The server of the page starts, or says why it cannot."""

import pytest

from manifeel_ms3.errors import MachineError

pytest.importorskip("viser")


def test_a_host_of_another_machine_is_refused():
    from manifeel_ms3.teleop.local_server import LocalServer

    with pytest.raises(MachineError, match=r"cannot listen on the host '203\.0\.113\.5' \(.+\); give one of its own addresses"):
        LocalServer("203.0.113.5", 0, "page")  # an address that is reserved for documentation (RFC 5737)
