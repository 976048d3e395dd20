"""Submissions, their checks, and the page that ranks them; see `manifeel leaderboard --help`."""
