"""The Panda with two fingers that carry gels as a URDF, derived from the one that ManiSkill ships.

Arm and hand keep their kinematics, inertia and convex collision shapes. Their visual meshes are decimated (a software
renderer transforms every vertex, and the packaged arm has 150,000 triangles), the fingers are replaced, and a gel pad hangs on
each finger by a fixed joint, so that the engine reports the whole wrench on the pad.

Frames (metres). A finger link has its origin 58.4 mm ahead of the hand, x across the finger, z along it towards the tip;
the gel's face lies in its plane y = 0. A gel link (`gel_left`, `gel_right`) is the pad frame itself: origin at the centre of
the untouched face, x along image rows (across the finger), y along image columns (towards the tip), z out of the gel.
"""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# (trimesh's annotations do not tell scenes and visuals of different kinds apart)
import hashlib
import tempfile
import xml.etree.ElementTree as ET
from pathlib import Path

import fast_simplification
import numpy as np
import trimesh
from mani_skill import PACKAGE_ASSET_DIR

from manifeel_ms3.paths import cache_dir, writable_cache

from . import fingers
from .fingers import GEL_CENTRE, Finger, gel_pad, replace_finger

HAND_TO_FINGER = 0.0584  # m: hand frame to finger frame, from the Panda's URDF
HAND_TO_TCP = HAND_TO_FINGER + GEL_CENTRE
TRIANGLES_PER_MESH = 1200  # with so many, a link's silhouette moves by less than a pixel at 256 x 256
FEWEST_TRIANGLES = 24  # of a small part of a mesh, which would vanish with its share of the triangles
SMOOTH_ANGLE = np.deg2rad(35)  # edges that are sharper stay sharp; chosen by eye

_SOURCE = Path(PACKAGE_ASSET_DIR) / "robots/panda"
_FINGERS = {"left": ("panda_leftfinger", 1.0), "right": ("panda_rightfinger", -1.0)}


def panda_gelsight_urdf(visuals: bool = True, finger: Finger | None = None) -> str:
    """Path of the derived URDF; it and the low-poly meshes are made on the first call and cached.

    Args:
        visuals: Whether links have visual meshes. Without them the file can be loaded where there is no renderer at all: SAPIEN
            makes a render material for every visual.
        finger: Sizes of the fingers; those of the GelSight R1.5 if not given.
    """
    finger = finger or Finger()
    # the key covers everything the files are made from: the modules, the finger, the package's URDF, and where it lies
    modules = Path(__file__).read_bytes() + Path(fingers.__file__).read_bytes()
    recipe = modules + repr(finger).encode() + (_SOURCE / "panda_v2.urdf").read_bytes() + str(_SOURCE).encode()
    folder = cache_dir() / f"panda_gelsight-{hashlib.sha256(recipe).hexdigest()[:12]}"
    if not (folder / "panda.urdf").is_file():
        _build_into(folder, finger)
    return str(folder / ("panda.urdf" if visuals else "panda_bare.urdf"))


def _build_into(folder: Path, finger: Finger) -> None:
    """Build in a temporary folder and move it in place, so that processes that start together do not disturb each other."""
    with writable_cache(), tempfile.TemporaryDirectory(dir=folder.parent) as scratch:
        work = Path(scratch) / "new"
        work.mkdir()
        tree = ET.parse(_SOURCE / "panda_v2.urdf")
        _derive(tree.getroot(), work, finger)
        tree.write(work / "panda.urdf")
        for link in tree.getroot().iter("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
        tree.write(work / "panda_bare.urdf")
        for name in ("panda.srdf", "panda_bare.srdf"):
            (work / name).write_bytes((_SOURCE / "panda_v2.srdf").read_bytes())
        try:
            work.replace(folder)
        except OSError:
            if not (folder / "panda.urdf").is_file():  # not another process's finished copy: a real error
                raise


def _derive(robot: ET.Element, work: Path, finger: Finger) -> None:
    for element in list(robot):
        if "pad" in element.get("name", ""):  # the stock pads are bare frames; the gel links replace them
            robot.remove(element)
    for link in robot.iter("link"):
        name = link.get("name", "")
        if "finger" in name:
            replace_finger(link, next(outward for own, outward in _FINGERS.values() if own == name), finger)
        for mesh in link.iterfind("visual/geometry/mesh"):
            low_poly = _decimate(_SOURCE / mesh.attrib["filename"], work)
            mesh.set("filename", low_poly)
        for mesh in link.iterfind("collision/geometry/mesh"):
            mesh.set("filename", str(_SOURCE / mesh.attrib["filename"]))
    tcp = robot.find("joint[@name='panda_hand_tcp_joint']/origin")
    assert tcp is not None
    tcp.set("xyz", f"0 0 {HAND_TO_TCP}")
    for side, (parent, outward) in _FINGERS.items():
        robot.extend(gel_pad(side, parent, outward, finger, work))


def _decimate(source: Path, work: Path) -> str:
    """Write a decimated copy of a mesh file beside the URDF, materials kept; return its name."""
    scene = trimesh.load(source, force="scene")
    parts: list[trimesh.Trimesh] = [part for part in scene.dump() if isinstance(part, trimesh.Trimesh)]
    total = sum(len(part.faces) for part in parts)
    out = trimesh.Scene()
    for part in parts:
        budget = max(FEWEST_TRIANGLES, TRIANGLES_PER_MESH * len(part.faces) // total)
        vertices, faces = np.asarray(part.vertices), np.asarray(part.faces)
        if len(faces) > budget:
            merged = trimesh.Trimesh(vertices, faces)  # seams of the texture are cracks to the decimator
            merged.merge_vertices(merge_tex=True, merge_norm=True)
            vertices, faces, *_ = fast_simplification.simplify(
                np.asarray(merged.vertices, np.float32), np.asarray(merged.faces), target_count=budget
            )
        material = trimesh.visual.material.PBRMaterial(
            baseColorFactor=part.visual.material.baseColorFactor, metallicFactor=0.1, roughnessFactor=0.5
        )
        # unmerged vertices give flat facets with true normals; smooth shading over big facets looks dented
        mesh = trimesh.Trimesh(vertices, faces, process=False)
        mesh.visual = trimesh.visual.TextureVisuals(material=material)
        out.add_geometry(trimesh.graph.smooth_shade(mesh, angle=SMOOTH_ANGLE))
    name = f"{source.stem}.glb"
    (work / name).write_bytes(out.export(file_type="glb"))
    return name
