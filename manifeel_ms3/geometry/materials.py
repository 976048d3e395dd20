"""Densities of the parts' materials, in kg/m^3: values of the CRC Handbook, and of data sheets for ABS."""

ABS = 1050.0
ALUMINIUM = 2700.0
BRASS = 8500.0
STEEL = 7850.0
