"""Densities, in kg/m^3, of the materials that parts are drawn as: handbook values (CRC Handbook; data sheets for ABS)."""

ABS = 1050.0
ALUMINIUM = 2700.0
BRASS = 8500.0
STEEL = 7850.0
