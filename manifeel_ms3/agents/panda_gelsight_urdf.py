"""The Panda with two fingers that carry gels as a URDF, derived from the one that ManiSkill ships.

Arm and hand keep their kinematics, inertia and convex collision shapes. Their visual meshes are decimated (a software
renderer transforms every vertex, and the packaged arm has 150,000 triangles), the fingers are replaced, and a gel pad hangs on
each finger by a fixed joint, so that the engine reports the whole wrench on the pad.

Frames (metres). A finger link has its origin 58.4 mm ahead of the hand, x across the finger, z along it towards the tip;
the gel's face lies in its plane y = 0. A gel link (`gel_left`, `gel_right`) is the pad frame itself: origin at the centre of
the untouched face, x across the finger (rising image rows), y towards the tip (rising image columns), z out of the gel.
"""

# pyright: reportArgumentType=false, reportAttributeAccessIssue=false, reportOptionalMemberAccess=false
# (trimesh's annotations do not tell scenes and visuals of different kinds apart)
import hashlib
import xml.etree.ElementTree as ET
from collections.abc import Iterator
from contextlib import contextmanager
from functools import cache
from importlib import metadata
from pathlib import Path

import fast_simplification
import numpy as np
import trimesh
from mani_skill import PACKAGE_ASSET_DIR
from scipy.spatial import KDTree
from trimesh.exchange.gltf import export_glb

from manifeel_ms3.files import FileWriteError, atomic_folder
from manifeel_ms3.paths import cache_dir, writable_cache
from manifeel_ms3.sensors import config

from . import fingers
from .fingers import GEL_CENTRE, Finger, gel_pad, replace_finger

HAND_TO_FINGER = 0.0584  # m: distance from the hand frame to the finger frame, from the Panda's URDF
HAND_TO_TCP = HAND_TO_FINGER + GEL_CENTRE
TRIANGLES_PER_MESH = 1200  # a link's silhouette then moves by less than a pixel at 256 x 256
TRIANGLES_OF_THE_HAND = 2400  # every camera sees the hand from near; with half as many triangles it looks dented
FEWEST_TRIANGLES = 24  # triangles of a small part of a mesh, which would vanish with its share of them; set once, not tuned
SMOOTH_ANGLE = np.deg2rad(35)  # rad: sharper edges stay sharp; chosen by eye
NORMAL_CANDIDATES = 8  # vertices of the full mesh among which a normal is chosen; chosen by eye
ROUGHNESS = 0.35  # roughness of the arm's painted and plastic surfaces; chosen by eye
LIBRARIES = ("mani-skill", "trimesh", "fast-simplification", "scipy", "numpy")  # that the meshes come from, or are made by
version = cache(metadata.version)  # takes 2 ms; each reset asks for 20, as ManiSkill asks for the robot's path four times

_SOURCE = Path(PACKAGE_ASSET_DIR) / "robots/panda"
_FINGERS = {"left": ("panda_leftfinger", 1.0), "right": ("panda_rightfinger", -1.0)}


def panda_gelsight_urdf(visuals: bool = True, finger: Finger | None = None) -> str:
    """Path of the derived URDF; it and the low-poly meshes are made on the first call and cached.

    Args:
        visuals: Whether links have visual meshes. Without them the file can be loaded where there is no renderer at all: SAPIEN
            makes a render material for every visual mesh.
        finger: Sizes of the fingers; those of the GelSight R1.5 if not given.
    """
    finger = finger or Finger()
    # the key covers everything the files are made from: the modules (that of the gel has the shape of its face), the libraries
    # (ManiSkill's holds the meshes), the finger, the package's URDF, and where it lies
    modules = b"".join(Path(file).read_bytes() for file in (__file__, fingers.__file__, config.__file__))
    given = [*map(version, LIBRARIES), repr(finger), str(_SOURCE)]
    recipe = modules + "\n".join(given).encode() + (_SOURCE / "panda_v2.urdf").read_bytes()
    folder = cache_dir() / f"panda_gelsight-{hashlib.sha256(recipe).hexdigest()[:12]}"
    if not (folder / "panda.urdf").is_file():
        _build_into(folder, finger)
    return str(folder / ("panda.urdf" if visuals else "panda_bare.urdf"))


def _build_into(folder: Path, finger: Finger) -> None:
    """Build a folder that appears as a whole; where processes start together, the first that is done provides it for all."""
    with writable_cache(), _unless_made_meanwhile(folder), atomic_folder(folder) as work:
        tree = ET.parse(_SOURCE / "panda_v2.urdf")
        _derive(tree.getroot(), work, finger)
        tree.write(work / "panda.urdf")
        for link in tree.getroot().iter("link"):
            for visual in link.findall("visual"):
                link.remove(visual)
        tree.write(work / "panda_bare.urdf")
        for name in ("panda.srdf", "panda_bare.srdf"):
            (work / name).write_bytes((_SOURCE / "panda_v2.srdf").read_bytes())


@contextmanager
def _unless_made_meanwhile(folder: Path) -> Iterator[None]:
    """Ignore that the folder cannot be written in this context if another process has made it in the meantime."""
    try:
        yield
    except FileWriteError:
        if not (folder / "panda.urdf").is_file():
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
    """Write a decimated copy of a mesh file, with its materials, beside the URDF; return its name."""
    scene = trimesh.load(source, force="scene")
    parts = [_placed(scene.geometry[name], matrix) for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry)]
    total = sum(len(part.faces) for part in parts)
    whole = TRIANGLES_OF_THE_HAND if source.stem == "hand" else TRIANGLES_PER_MESH
    out = trimesh.Scene()
    for part in parts:
        out.add_geometry(_decimated(part, max(FEWEST_TRIANGLES, whole * len(part.faces) // total)))
    name = f"{source.stem}.glb"
    (work / name).write_bytes(export_glb(out, include_normals=True))
    return name


def _placed(mesh: trimesh.Trimesh, matrix: np.ndarray) -> trimesh.Trimesh:
    """Mesh at the place of its node, with the normals of its file; `Scene.dump` would compute others."""
    vertices, normals = trimesh.transform_points(mesh.vertices, matrix), mesh.vertex_normals @ matrix[:3, :3].T
    return trimesh.Trimesh(vertices, mesh.faces, vertex_normals=normals, visual=mesh.visual, process=False)


def _decimated(part: trimesh.Trimesh, budget: int) -> trimesh.Trimesh:
    """A mesh of one material with at most about `budget` triangles, in the colour and with the normals of the full one."""
    vertices, faces = np.asarray(part.vertices), np.asarray(part.faces)
    if len(faces) > budget:
        merged = trimesh.Trimesh(vertices, faces)  # seams of the texture are cracks to the decimator
        merged.merge_vertices(merge_tex=True, merge_norm=True)
        vertices, faces, *_ = fast_simplification.simplify(
            np.asarray(merged.vertices, np.float32), np.asarray(merged.faces), target_count=budget
        )
    split = trimesh.graph.smooth_shade(trimesh.Trimesh(vertices, faces, process=False), angle=SMOOTH_ANGLE)
    material = trimesh.visual.material.PBRMaterial(
        baseColorFactor=part.visual.material.baseColorFactor, metallicFactor=0.0, roughnessFactor=ROUGHNESS
    )
    # a mesh without texture coordinates loses its material when it is exported
    visual = trimesh.visual.TextureVisuals(uv=np.zeros((len(split.vertices), 2)), material=material)
    return trimesh.Trimesh(
        split.vertices, split.faces, vertex_normals=_nearest_normals(split, part), visual=visual, process=False
    )


def _nearest_normals(mesh: trimesh.Trimesh, full: trimesh.Trimesh) -> np.ndarray:
    """Normals (n, 3) of the full mesh where the vertices of a decimated one are.

    The decimated mesh's own normals are those of its few big facets, and make them look dented. Of the nearest vertices of the
    full mesh, the one counts whose normal is most like the decimated mesh's, which tells the two sides of an edge apart.
    """
    _, nearest = KDTree(full.vertices).query(mesh.vertices, k=min(NORMAL_CANDIDATES, len(full.vertices)))
    candidates = full.vertex_normals[nearest]  # (n, candidates, 3)
    best = np.einsum("nkd,nd->nk", candidates, mesh.vertex_normals).argmax(axis=1)
    normals = candidates[np.arange(len(best)), best]
    defined = np.linalg.norm(normals, axis=1, keepdims=True) > 0.5  # vertices of empty triangles have none
    return np.where(defined, normals, mesh.vertex_normals)
