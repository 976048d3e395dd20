"""Addresses under which a machine reaches itself and no other machine reaches it."""

LOOPBACK = "127.0.0.1"
"""Loopback address (RFC 1122, section 3.2.1.3): a server that listens on it is reached from its own machine only."""
LOOPBACK_NAMES = frozenset({"localhost", LOOPBACK, "::1"})
"""Names and addresses under which a machine reaches itself, for IPv4 and IPv6."""
