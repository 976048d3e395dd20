"""Flow Matching (Lipman et al. 2023)."""
