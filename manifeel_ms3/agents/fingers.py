"""The fingers of the robot for any sensor: a housing and a gel pad, as parts of a URDF.

A domed gel is drawn as it is, but collides as a light grip flattens it: as a box, whose face is the part of the dome that lies
less than `FLATTENED` under the highest point, and around it as the dome, moved out by `FLATTENED`, with its top cut off below
the box. A flat part then rests on four contact points, as on a flat gel.
"""

import xml.etree.ElementTree as ET
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import trimesh

from manifeel_ms3.sensors.config import GelConfig, HousingConfig, TactileSensorConfig

GEL_CENTRE = 0.082  # m along the finger, the same for all sensors: the R1.5's gel then ends 2 mm before the tip
FINGER_MASS, GEL_MASS = 0.08, 0.01  # kg, estimated
FLATTENED = 5e-4  # m: 2.6 N flatten a dome with a radius of 35 mm so far (F = pi K R d^2)
CUT = 2e-3  # m under the box's face: more than 30 N on two contact points press the box in, so that the dome carries nothing
MIDDLE = 0.012  # m: side of the middle box. A golf ball gripped with 20 N slips at 0.073 N m; on a real gel, at 0.093 N m
MIDDLE_SHARE = 0.6  # largest side of the middle box, as a share of the flat face's shorter side; that of a dome is small
DRAWN_POINTS, SOLID_POINTS = 41, 13  # points along each side of the dome that is drawn, and of the one that collides (chosen)
SIZE_DIGITS = 6  # decimals, in m, to which the finger's length is rounded: a micrometre
HOUSING_COLOUR, GEL_COLOUR = "0.16 0.16 0.18 1", "0.75 0.77 0.8 1"  # RGBA, chosen by eye


@dataclass(frozen=True)
class Finger:
    """Sizes of a finger and its gel; the defaults are those of the GelSight R1.5."""

    width: float = HousingConfig.width
    """Extent of the housing across the finger, m."""
    depth: float = HousingConfig.depth
    """Extent of the housing from the gel's back to the finger's back, m."""
    beyond_gel: float = HousingConfig.beyond_gel
    """Distance from the gel's end to the fingertip, m."""
    protrusion: float = HousingConfig.protrusion
    """Height of the gel's highest point above the housing, m."""
    gel_size: tuple[float, float] = GelConfig.size
    """Extent of the gel across and along the finger, m."""
    curvature: tuple[float, float] = GelConfig.curvature
    """Curvature of the gel's face across and along the finger, 1/m."""
    grips_round_parts: bool = False
    """Whether a gel collides as five boxes, its middle and four around it, so that a ball or a bulb touches it in five points
    instead of one, about which it would spin freely. One box holds flat parts as firmly, at half the cost."""

    @classmethod
    def of(cls, sensor: TactileSensorConfig, grips_round_parts: bool = False) -> "Finger":
        """Finger that carries a sensor.

        Args:
            sensor: Configuration of the pad.
            grips_round_parts: Whether the parts that it holds are round.
        """
        housing, gel = sensor.housing, sensor.gel
        sizes = (housing.width, housing.depth, housing.beyond_gel, housing.protrusion)
        return cls(*sizes, gel.size, gel.curvature, grips_round_parts)

    @property
    def size(self) -> tuple[float, float, float]:
        """Extent of the housing across the finger, from front to back, and along the finger, m."""
        return self.width, self.depth, round(GEL_CENTRE + self.gel_size[1] / 2 + self.beyond_gel, SIZE_DIGITS)

    @property
    def gel_box(self) -> tuple[float, float, float]:
        """Extent of the gel across, along and out of the finger, m."""
        return *self.gel_size, self.protrusion

    @property
    def flat_box(self) -> tuple[float, float, float]:
        """Extent of the box that stands for the middle of a dome, m."""
        sides = (2 * np.sqrt(FLATTENED / c) if c > 0 else s for c, s in zip(self.curvature, self.gel_size, strict=True))
        across, along = (float(min(side, s)) for side, s in zip(sides, self.gel_size, strict=True))
        return across, along, self.protrusion

    @property
    def solid_boxes(self) -> list[tuple[tuple, tuple]]:
        """Sizes and centres, in the pad frame, m, of the boxes that the gel's face, or the middle of a dome, collides as."""
        across, along, high = self.flat_box
        middle, z = min(MIDDLE, MIDDLE_SHARE * min(across, along)), -high / 2
        if not self.grips_round_parts:
            return [(self.flat_box, (0.0, 0.0, z))]
        boxes: list[tuple[tuple, tuple]] = [((middle, middle, high), (0.0, 0.0, z))]
        for side in (-1, 1):
            boxes.append((((across - middle) / 2, along, high), (side * (across + middle) / 4, 0.0, z)))
            boxes.append(((middle, (along - middle) / 2, high), (0.0, side * (along + middle) / 4, z)))
        return boxes

    def dome(self, points: int, raised: float = 0.0, cut: float = 0.0) -> trimesh.Trimesh:
        """The gel as a convex mesh in the pad frame, m: the face, and the edge of its back.

        Args:
            points: Points of the face along each side.
            raised: Distance by which the face is moved out before it is cut off, m.
            cut: Depth at which it is cut off, m.
        """
        x, y = (grid.ravel() for grid in np.meshgrid(*(np.linspace(-s / 2, s / 2, points) for s in self.gel_size)))
        sag = np.maximum(GelConfig(size=self.gel_size, curvature=self.curvature).sag(x, y) - raised, cut)
        back = [(i * self.gel_size[0] / 2, j * self.gel_size[1] / 2, -self.protrusion) for i in (-1, 1) for j in (-1, 1)]
        return trimesh.convex.convex_hull(np.vstack([np.column_stack([x, y, -sag]), back]))


def replace_finger(link: ET.Element, outward: float, finger: Finger) -> None:
    """Make a finger link of the stock Panda the housing of a sensor.

    Args:
        link: The link.
        outward: Direction of the finger's back along the link's y: 1 or -1.
        finger: Sizes of the finger.
    """
    for tag in ("visual", "collision", "inertial"):
        for element in link.findall(tag):
            link.remove(element)
    _, deep, long = finger.size
    centre = (0.0, outward * (finger.protrusion + deep / 2), long / 2)
    _add_box(link, finger.size, centre, HOUSING_COLOUR)
    _add_inertia(link, mass=FINGER_MASS, size=finger.size, centre=centre)


def gel_pad(side: str, parent: str, outward: float, finger: Finger, folder: Path) -> tuple[ET.Element, ET.Element]:
    """Link of a gel pad, and the joint that fixes it to its finger.

    Args:
        side: "left" or "right".
        parent: Name of the finger's link.
        outward: Direction of the finger's back along that link's y: 1 or -1.
        finger: Sizes of the finger.
        folder: Folder of the URDF, into which the meshes of a dome are written.
    """
    name = f"gel_{side}"
    link = ET.Element("link", name=name)
    centre = (0.0, 0.0, -finger.protrusion / 2)
    if finger.curvature == (0.0, 0.0):
        _add_box(link, finger.gel_box, centre, GEL_COLOUR, tags=("visual",))
    else:
        solid = finger.dome(SOLID_POINTS, FLATTENED, CUT)
        for tag, mesh in (("visual", finger.dome(DRAWN_POINTS)), ("collision", solid)):
            mesh.export(folder / f"gel_{tag}.obj")
            _add_mesh(link, tag, f"gel_{tag}.obj", GEL_COLOUR)
    for size, place in finger.solid_boxes:
        _add_box(link, size, place, tags=("collision",))
    _add_inertia(link, mass=GEL_MASS, size=finger.gel_box, centre=centre)
    joint = ET.Element("joint", name=f"{name}_joint", type="fixed")
    ET.SubElement(joint, "parent", link=parent)
    ET.SubElement(joint, "child", link=name)
    # columns of the rotation: pad x, y, z in the finger frame; roll +90 deg for z = -y (left), -90 deg for z = +y (right)
    rpy = f"{np.pi / 2} 0 0" if outward > 0 else f"{np.pi / 2} 0 {np.pi}"
    ET.SubElement(joint, "origin", xyz=f"0 0 {GEL_CENTRE}", rpy=rpy)
    return link, joint


def _add_box(
    link: ET.Element, size: tuple, centre: tuple, colour: str = "", tags: tuple[str, ...] = ("visual", "collision")
) -> None:
    for tag in tags:
        shape = ET.SubElement(link, tag)
        ET.SubElement(shape, "origin", xyz=_text(centre), rpy="0 0 0")
        ET.SubElement(ET.SubElement(shape, "geometry"), "box", size=_text(size))
        if tag == "visual":
            _add_colour(link, shape, colour)


def _add_mesh(link: ET.Element, tag: str, filename: str, colour: str) -> None:
    shape = ET.SubElement(link, tag)
    ET.SubElement(shape, "origin", xyz="0 0 0", rpy="0 0 0")
    ET.SubElement(ET.SubElement(shape, "geometry"), "mesh", filename=filename)
    if tag == "visual":
        _add_colour(link, shape, colour)


def _add_colour(link: ET.Element, shape: ET.Element, colour: str) -> None:
    ET.SubElement(ET.SubElement(shape, "material", name=link.get("name", "")), "color", rgba=colour)


def _add_inertia(link: ET.Element, mass: float, size: tuple, centre: tuple) -> None:
    inertial = ET.SubElement(link, "inertial")
    ET.SubElement(inertial, "origin", xyz=_text(centre), rpy="0 0 0")
    ET.SubElement(inertial, "mass", value=str(mass))
    xx, yy, zz = (mass / 12 * (sum(s * s for s in size) - size[axis] ** 2) for axis in range(3))
    ET.SubElement(inertial, "inertia", ixx=f"{xx}", iyy=f"{yy}", izz=f"{zz}", ixy="0", ixz="0", iyz="0")


def _text(values: tuple) -> str:
    return " ".join(str(v) for v in values)
