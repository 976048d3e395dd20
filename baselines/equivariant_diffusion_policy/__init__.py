"""Equivariant Diffusion Policy (Wang et al. 2024)."""
