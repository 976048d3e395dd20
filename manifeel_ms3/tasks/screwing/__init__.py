"""The screwing tasks: a held part is screwed onto a bolt or into a holder."""
