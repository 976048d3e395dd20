"""Looks of surfaces: their colour, and how metallic and rough they are. All values are chosen by eye."""

from dataclasses import dataclass

from sapien.render import RenderMaterial

SPECULAR = 0.5
"""Specular reflection of all surfaces, in [0, 1]."""


@dataclass(frozen=True)
class Look:
    """Look of a surface."""

    colour: tuple[float, float, float]
    """Colour in linear RGB, in [0, 1]; for a metal, that of its reflections."""
    metallic: float = 0.0
    """1 for metals, 0 for all other materials."""
    roughness: float = 0.45
    """Roughness, from 0 (polished) to 1 (matt)."""

    def material(self) -> RenderMaterial:
        """Make a material of SAPIEN with this look, which works only where there is a renderer."""
        colour = [*self.colour, 1.0]
        return RenderMaterial(base_color=colour, metallic=self.metallic, roughness=self.roughness, specular=SPECULAR)


BRASS = Look((0.86, 0.62, 0.22), metallic=1.0, roughness=0.30)
STEEL = Look((0.72, 0.73, 0.75), metallic=1.0, roughness=0.28)
BLUE_PLASTIC = Look((0.10, 0.22, 0.52))
DARK_PLASTIC = Look((0.035, 0.037, 0.042))
BLACK_PLASTIC = Look((0.015, 0.015, 0.016))
WHITE_PLASTIC = Look((0.82, 0.82, 0.79))
OPAL_GLASS = Look((0.88, 0.87, 0.82), roughness=0.12)
CARDBOARD = Look((0.27, 0.17, 0.10), roughness=0.85)
CONCRETE = Look((0.22, 0.23, 0.25), roughness=0.9)
