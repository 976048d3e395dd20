"""Where processes listen, as the kernel reports it."""

import socket

import psutil

LOOPBACK = {"127.0.0.1", "::1", "::ffff:127.0.0.1"}
"""Addresses that no other machine reaches; the last is an IPv4 address in the form that a socket for IPv6 may report."""


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return probe.getsockname()[1]


def listening(process: psutil.Process) -> dict[tuple[str, int], str]:
    """Addresses, as host and port, on which a process and its descendants listen, and the names of those processes."""
    found = {}
    for one in (process, *process.children(recursive=True)):
        try:
            connections = one.net_connections("inet")
        except (psutil.NoSuchProcess, psutil.AccessDenied):
            continue
        found |= {tuple(c.laddr): one.name() for c in connections if c.status == psutil.CONN_LISTEN}
    return found


def hosts_by_port(process: psutil.Process) -> dict[int, set[str]]:
    """Hosts on which a process and its descendants listen, by port."""
    found: dict[int, set[str]] = {}
    for host, port in listening(process):
        found.setdefault(port, set()).add(host)
    return found


def hosts(process: psutil.Process) -> set[str]:
    """Hosts on which a process and its descendants listen, on any port."""
    return {host for host, _ in listening(process)}
