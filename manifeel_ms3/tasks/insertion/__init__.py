"""The insertion tasks: a held part is put into a socket or onto a shaft."""
