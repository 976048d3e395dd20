"""Submissions, their checks, and the page that ranks them; see `python -m manifeel_ms3.leaderboard --help`."""
