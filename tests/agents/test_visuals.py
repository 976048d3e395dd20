"""The low-poly robot looks like the one that ManiSkill ships."""

import xml.etree.ElementTree as ET
from pathlib import Path

import numpy as np
import pytest
import trimesh
from mani_skill import PACKAGE_ASSET_DIR
from scipy.spatial import KDTree

from manifeel_ms3.agents import panda_gelsight_urdf as derived
from manifeel_ms3.agents.panda_gelsight_urdf import panda_gelsight_urdf
from manifeel_ms3.sensors import config


@pytest.fixture(scope="module")
def low_poly() -> dict[str, list]:
    urdf = Path(panda_gelsight_urdf())
    files = [mesh.attrib["filename"] for mesh in ET.parse(urdf).getroot().iterfind("link/visual/geometry/mesh")]
    return {name: meshes_of(urdf.parent / name) for name in files}


def meshes_of(file: Path) -> list[tuple[tuple[int, ...], np.ndarray, np.ndarray]]:
    """Colour, vertices (n, 3) and normals (n, 3) of each mesh in a file."""
    scene, found = trimesh.load(file, force="scene"), []
    for matrix, name in map(scene.graph.get, scene.graph.nodes_geometry):
        mesh = scene.geometry[name]
        placed = trimesh.transform_points(mesh.vertices, matrix), mesh.vertex_normals @ matrix[:3, :3].T
        found.append((tuple(mesh.visual.material.baseColorFactor), *placed))
    return found


def original_of(name: str) -> list:
    (file,) = [file for file in Path(PACKAGE_ASSET_DIR).glob("robots/panda/**/visual/*.glb") if file.name == name]
    return meshes_of(file)


def test_every_mesh_keeps_its_colours(low_poly):
    colours = {name: sorted(colour for colour, *_ in meshes) for name, meshes in low_poly.items()}
    assert colours == {name: sorted(colour for colour, *_ in original_of(name)) for name in low_poly}
    assert len(set(colours["hand.glb"])) == 2  # white and black plastic


def test_normals_are_those_of_the_full_mesh(low_poly):
    """The big facets of a decimated mesh, shaded by their own normals, look dented."""
    for name, meshes in low_poly.items():
        originals = original_of(name)
        for colour, vertices, normals in meshes:
            _, points, full = zip(*(mesh for mesh in originals if mesh[0] == colour), strict=True)
            points, full = np.concatenate(points), np.concatenate(full)
            _, nearest = KDTree(points).query(vertices, k=min(16, len(points)))
            cosine = np.einsum("nkd,nd->nk", full[nearest], normals).max(axis=1)
            assert np.quantile(cosine, 0.02) > np.cos(np.deg2rad(1)), name


def test_another_shape_of_the_gel_or_another_library_makes_files_of_its_own(monkeypatch, tmp_path):
    monkeypatch.setattr(derived, "_build_into", lambda folder, finger: None)
    present = panda_gelsight_urdf()
    assert panda_gelsight_urdf() == present
    with monkeypatch.context() as changed:
        changed.setattr(derived, "version", lambda name: "of another day")
        assert panda_gelsight_urdf() != present
    steeper = tmp_path / "config.py"
    steeper.write_text(Path(config.__file__).read_text().replace("(1.0 + root)", "(0.9 + root)"))
    monkeypatch.setattr(config, "__file__", str(steeper))
    assert panda_gelsight_urdf() != present
