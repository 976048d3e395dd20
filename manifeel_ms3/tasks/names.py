"""Ids of tasks, and their short names."""

PREFIX, SUFFIX = "ManiFeel-", "-v1"


def short_name(env_id: str) -> str:
    """ "PegInsertion" of "ManiFeel-PegInsertion-v1"."""
    return env_id.removeprefix(PREFIX).removesuffix(SUFFIX)
