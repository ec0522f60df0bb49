"""What is in a mesh or point cloud file, in numbers, and whether it is in order.

Lengths, areas and volumes are in units of the file. Topology is examined as the file has it; where vertices at the
same place are stored several times, as along the seams of a texture, also with those merged.
"""

import json
import math
from collections.abc import Iterator
from dataclasses import asdict, dataclass
from functools import cached_property
from typing import Any

import torch
from torch import Tensor

from rendra.ops import self_intersections
from rendra.renderer.mesh.textures import TexturesAtlas, TexturesVertex
from rendra.structures import Meshes
from rendra_lab import mesh_quality as quality
from rendra_lab.mesh_asset import Asset, Material

_LISTED = 8  # sizes of components and holes that a report spells out
_BOX_OF_NORMALIZED = 2.2  # longest side of what was scaled to a unit ball or box, with a margin


@dataclass(frozen=True)
class Bounds:
    """Where the finite points lie, or the finite vertices that faces use.

    Attributes:
        low, high: corners of the bounding box.
        extent: its sides.
        diagonal: of the box.
        scale_guess: what one unit probably is.
    """

    low: tuple[float, ...]
    high: tuple[float, ...]
    extent: tuple[float, ...]
    diagonal: float
    scale_guess: str


@dataclass(frozen=True)
class Topology:
    """How the faces hang together; see `mesh_quality` for each number."""

    verts: int
    edges: int
    components: int
    component_faces: tuple[int, ...]  # of the largest
    euler_characteristic: int
    genus: int | None
    watertight: bool
    holes: int
    hole_edges: tuple[int, ...]  # of the largest holes
    boundary_edges: int
    non_manifold_edges: int
    non_manifold_verts: int
    inconsistent_edges: int
    flipped_faces: int
    inward_faces: int
    self_intersections: int  # pairs of faces


@dataclass(frozen=True)
class Findings:
    """Where the faults of a mesh are.

    Attributes:
        mesh: the examined mesh; its faces are those of the file.
        edges: name of a fault -> edges as pairs of vertices (K, 2).
        faces: name of a fault -> which faces, (F,) bool.
    """

    mesh: Meshes
    edges: dict[str, Tensor]
    faces: dict[str, Tensor]


class Examination:
    """One mesh looked through once, for the report and for the pictures."""

    def __init__(self, mesh: Meshes) -> None:
        self.mesh = mesh

    @cached_property
    def findings(self) -> Findings:
        """Where the faults are."""
        mesh = self.mesh
        crossing = torch.zeros(len(mesh.faces_packed()), dtype=torch.bool, device=mesh.device)
        crossing[self._crossings.reshape(-1)] = True
        edges = {
            "holes": quality.boundary_edges(mesh),
            "non-manifold edges": quality.non_manifold_edges(mesh),
        }
        faces = {
            "flipped faces": quality.flipped_faces(mesh),
            "inside-out faces": quality.inward_faces(mesh),
            "self-intersections": crossing,
            "degenerate faces": quality.degenerate_faces(mesh),
            "duplicate faces": quality.duplicate_faces(mesh),
        }
        return Findings(mesh, edges, faces)

    @cached_property
    def _crossings(self) -> Tensor:
        return self_intersections(self.mesh)

    @cached_property
    def topology(self) -> Topology:
        """The numbers."""
        mesh, found = self.mesh, self.findings
        loops = quality.boundary_loops(mesh).bincount().sort(descending=True).values.tolist()
        parts = quality.components(mesh).bincount().tolist()
        return Topology(
            verts=len(mesh.verts_packed()),
            edges=len(mesh.edges_packed()),
            components=len(parts),
            component_faces=tuple(parts[:_LISTED]),
            euler_characteristic=quality.euler_characteristic(mesh),
            genus=quality.genus(mesh),
            watertight=quality.is_watertight(mesh),
            holes=len(loops),
            hole_edges=tuple(loops[:_LISTED]),
            boundary_edges=len(found.edges["holes"]),
            non_manifold_edges=len(found.edges["non-manifold edges"]),
            non_manifold_verts=len(quality.non_manifold_verts(mesh)),
            inconsistent_edges=len(quality.inconsistent_edges(mesh)),
            flipped_faces=int(found.faces["flipped faces"].sum()),
            inward_faces=int(found.faces["inside-out faces"].sum()),
            self_intersections=len(self._crossings),
        )


@dataclass(frozen=True)
class MeshReport:
    """The numbers of a mesh file.

    Attributes:
        merged: the topology with vertices at the same place merged; None where there are none.
        volume: None unless watertight, as the file has it or merged.
        colors: what the faces or vertices carry: "none", "image", "vertex colours" or "face colours".
        uv_range: smallest and largest u and v of the corners, or None.
        uvs_outside: how many texture coordinates in use lie outside [0, 1].
        normals: where the file stores normals: "none", "vertices" or "corners".
        wrong_normals: how many of those point away from the side that the faces look to.
        verdict: one line.
    """

    file: str
    kind: str
    verts: int
    faces: int
    bounds: Bounds | None
    area: float
    volume: float | None
    edge_length_min: float
    edge_length_mean: float
    edge_length_max: float
    edge_length_spread: float
    mean_dihedral_deg: float
    topology: Topology
    merged: Topology | None
    not_finite_verts: int
    duplicate_verts: int
    unreferenced_verts: int
    degenerate_faces: int
    duplicate_faces: int
    colors: str
    materials: tuple[dict[str, Any], ...]
    uvs: int
    uv_range: tuple[tuple[float, float], ...] | None
    uvs_outside: int
    normals: str
    wrong_normals: int
    notes: tuple[str, ...]
    verdict: str


@dataclass(frozen=True)
class CloudReport:
    """The numbers of a point cloud file.

    Attributes:
        spacing_min, spacing_median, spacing_mean, spacing_max: distance of a point from its nearest neighbour, of
            finite points, those at the same place counted once; None for fewer than two.
        features: how many channels a point has besides; colours are 3 or 4.
        feature_range: smallest and largest feature, or None.
        verdict: one line.
    """

    file: str
    kind: str
    points: int
    bounds: Bounds | None
    spacing_min: float | None
    spacing_median: float | None
    spacing_mean: float | None
    spacing_max: float | None
    duplicate_points: int
    not_finite_points: int
    normals: int
    normals_not_unit: int
    features: int
    feature_range: tuple[float, float] | None
    notes: tuple[str, ...]
    verdict: str


@torch.no_grad()
def report_on(asset: Asset) -> tuple[MeshReport | CloudReport, Findings | None]:
    """The numbers of a file, and where the faults of a mesh are."""
    if asset.mesh is None:
        return _report_cloud(asset), None
    return _report_mesh(asset, asset.mesh)


def _report_mesh(asset: Asset, stored: Meshes) -> tuple[MeshReport, Findings]:
    finite = stored.verts_packed().isfinite().all(1)
    mesh = stored if finite.all() else _finite_part(stored, finite)
    as_stored = Examination(mesh)
    duplicates = int(quality.duplicate_verts(stored).sum())
    merged = Examination(quality.merge_verts(mesh)) if duplicates else None
    best = merged if merged is not None and _has_seams(mesh, merged.mesh) else as_stored
    lengths = quality.edge_lengths(best.mesh)
    place, wrong = _stored_normals(asset, mesh)
    used, uv_range, outside = _uv_facts(asset)
    numbers: dict[str, Any] = {
        "file": asset.path.name,
        "kind": "mesh",
        "verts": len(finite),
        "faces": len(stored.faces_packed()),
        "bounds": _bounds(mesh.verts_packed()[~quality.unreferenced_verts(mesh)]),
        "area": quality.surface_area(mesh),
        "volume": quality.signed_volume(best.mesh) if best.topology.watertight else None,
        "edge_length_min": float(lengths.amin()) if len(lengths) else math.nan,
        "edge_length_mean": float(lengths.mean()),
        "edge_length_max": float(lengths.amax()) if len(lengths) else math.nan,
        "edge_length_spread": float(quality.edge_length_spread(best.mesh)),
        "mean_dihedral_deg": float(quality.mean_dihedral_deg(best.mesh)),
        "topology": as_stored.topology,
        "merged": None if merged is None else merged.topology,
        "not_finite_verts": int((~finite).sum()),
        "duplicate_verts": duplicates,
        "unreferenced_verts": int(quality.unreferenced_verts(stored).sum()),
        "degenerate_faces": int(best.findings.faces["degenerate faces"].sum()),
        "duplicate_faces": int(best.findings.faces["duplicate faces"].sum()),
        "colors": _colors(asset),
        "materials": tuple(map(_material_facts, asset.materials)),
        "uvs": used,
        "uv_range": uv_range,
        "uvs_outside": outside,
        "normals": place,
        "wrong_normals": wrong,
        "notes": asset.notes,
    }
    verdict = _judge(numbers, best.topology, merged_count=duplicates if best is merged else 0)
    return MeshReport(**numbers, verdict=verdict), best.findings


def _finite_part(mesh: Meshes, finite: Tensor) -> Meshes:
    """The faces whose vertices are all finite; the others are 0 and unused."""
    faces = mesh.faces_packed()
    verts = mesh.verts_packed().masked_fill(~finite[:, None], 0.0)
    normals = [mesh.verts_normals_packed()] if mesh.has_given_normals else None
    return Meshes([verts], [faces[finite[faces].all(1)]], verts_normals=normals)


def _has_seams(mesh: Meshes, merged: Meshes) -> bool:
    return len(quality.boundary_edges(merged)) < len(quality.boundary_edges(mesh))


def _stored_normals(asset: Asset, mesh: Meshes) -> tuple[str, int]:
    corners = asset.normals_at_corners
    if corners is not None and asset.mesh is not None:
        faces = asset.mesh.faces_normals_packed()[:, None]
        return "corners", int(((corners * faces).sum(-1) < 0).sum())
    if not mesh.has_given_normals:
        return "none", 0
    return "vertices", int(quality.wrong_normals(mesh).sum())


def _uv_facts(asset: Asset) -> tuple[int, tuple[tuple[float, float], ...] | None, int]:
    """How many coordinates there are, the range of those in use, and how many of them lie outside [0, 1]."""
    if asset.uvs is None or asset.faces_uvs is None:
        return 0, None, 0
    rows = asset.faces_uvs[asset.faces_uvs >= 0].unique()
    if not len(rows):
        return len(asset.uvs), None, 0
    low, high = asset.uvs[rows].aminmax(dim=0)
    outside = ((asset.uvs[rows] < 0) | (asset.uvs[rows] > 1)).any(1)
    return len(asset.uvs), tuple(zip(low.tolist(), high.tolist(), strict=True)), int(outside.sum())


def _colors(asset: Asset) -> str:
    textures = None if asset.mesh is None else asset.mesh.textures
    if any(material.image is not None for material in asset.materials):
        return "image"
    if isinstance(textures, TexturesVertex):
        return "vertex colours"
    plain = any(material.color is not None for material in asset.materials)
    return "face colours" if plain or isinstance(textures, TexturesAtlas) else "none"


def _material_facts(material: Material) -> dict[str, Any]:
    size = None if material.image is None else (material.image.shape[1], material.image.shape[0])
    used = None if material.faces is None else len(material.faces)
    return {"name": material.name, "diffuse_color": material.color, "image_size_px": size, "faces": used}


def _bounds(points: Tensor) -> Bounds | None:
    if not len(points):
        return None
    points = points.double()
    low, high = points.aminmax(dim=0)
    extent = high - low
    return Bounds(
        tuple(low.tolist()),
        tuple(high.tolist()),
        tuple(extent.tolist()),
        float(extent.norm()),
        _guess_scale(float(extent.amax()), float((low + high).abs().amax() / 2)),
    )


def _guess_scale(longest: float, off_centre: float) -> str:
    """What one unit probably is, from the longest side and how far the middle is from the origin."""
    if longest == 0:
        return "a single point"
    if 0.5 <= longest <= _BOX_OF_NORMALIZED and off_centre <= longest:
        return "normalised to about the unit box or ball, or metres"
    unit = "metres" if longest < 50 else "centimetres" if longest < 400 else "millimetres"
    return f"perhaps {unit}"


def _judge(numbers: dict[str, Any], topology: Topology, merged_count: int) -> str:
    """One line: what kind of surface it is, and its faults."""
    faults = list(_faults(numbers, topology))
    state = [
        "closed" if not topology.boundary_edges else f"open ({_count(topology.holes, 'hole')})",
        "oriented" if not (topology.inconsistent_edges or topology.inward_faces) else "",
        "manifold" if not (topology.non_manifold_edges or topology.non_manifold_verts) else "",
    ]
    line = ", ".join(filter(None, state))
    if merged_count:
        line += f" once {merged_count:,} vertices at shared places are merged"
    return f"{line}; faults: {', '.join(faults)}" if faults else line


def _faults(numbers: dict[str, Any], topology: Topology) -> Iterator[str]:
    if topology.inconsistent_edges and not topology.flipped_faces:
        yield "cannot be oriented"
    counted = (
        (topology.non_manifold_edges, "non-manifold edge"),
        (topology.non_manifold_verts, "non-manifold vertex"),
        (topology.flipped_faces, "flipped face"),
        (topology.inward_faces, "inside-out face"),
        (topology.self_intersections, "self-intersection"),
        (numbers["degenerate_faces"], "degenerate face"),
        (numbers["duplicate_faces"], "duplicate face"),
        (numbers["not_finite_verts"], "vertex that is not finite"),
        (numbers["unreferenced_verts"], "unused vertex"),
        (numbers["wrong_normals"], "wrong normal"),
    )
    for count, name in counted:
        if count:
            yield _count(count, name)


def _count(count: int, name: str) -> str:
    if count == 1:
        return f"1 {name}"
    head, _, tail = name.partition(" that is ")
    plural = head[:-2] + "ices" if head.endswith("vertex") else head + "s"
    return f"{count:,} {plural}{f' that are {tail}' if tail else ''}"


def _report_cloud(asset: Asset) -> CloudReport:
    assert asset.cloud is not None
    points, normals, features = asset.cloud.get_cloud(0)
    finite = points.isfinite().all(1)
    repeated = quality.repeated_points(points) & finite
    spacing = quality.nearest_distances(points[finite & ~repeated])
    off_unit = torch.zeros(0) if normals is None else (normals.norm(dim=1) - 1).abs()
    numbers: dict[str, Any] = {
        "duplicate_points": int(repeated.sum()),
        "not_finite_points": int((~finite).sum()),
        "normals_not_unit": int((~(off_unit < 1e-3)).sum()),
    }
    words = {
        "duplicate_points": "duplicate point",
        "not_finite_points": "point that is not finite",
        "normals_not_unit": "normal whose length is not 1",
    }
    faults = [_count(numbers[name], word) for name, word in words.items() if numbers[name]]
    values = None if features is None or not features.numel() else features.aminmax()
    return CloudReport(
        file=asset.path.name,
        kind="cloud",
        points=len(points),
        bounds=_bounds(points[finite]),
        spacing_min=float(spacing.amin()) if len(spacing) else None,
        spacing_median=float(spacing.median()) if len(spacing) else None,
        spacing_mean=float(spacing.mean()) if len(spacing) else None,
        spacing_max=float(spacing.amax()) if len(spacing) else None,
        normals=0 if normals is None else len(normals),
        features=0 if features is None else features.shape[1],
        feature_range=None if values is None else (float(values.min), float(values.max)),
        notes=asset.notes,
        verdict=f"{_count(len(points), 'point')}{'; faults: ' + ', '.join(faults) if faults else ', in order'}",
        **numbers,
    )


def as_json(report: MeshReport | CloudReport) -> str:
    """The report as JSON text; what is no number becomes null."""
    return json.dumps(_plain(asdict(report)), indent=2, allow_nan=False) + "\n"


def _plain(value: Any) -> Any:
    if isinstance(value, dict):
        return {key: _plain(each) for key, each in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(each) for each in value]
    return None if isinstance(value, float) and not math.isfinite(value) else value


def as_text(report: MeshReport | CloudReport) -> str:
    """The report for a terminal, the verdict last."""
    rows = _cloud_rows(report) if isinstance(report, CloudReport) else _mesh_rows(report)
    lines = [f"  {name:<25} {value}" for name, value in rows if value]
    lines += [f"  note: {note}" for note in report.notes]
    return "\n".join([report.file, *lines, report.verdict])


def _mesh_rows(report: MeshReport) -> Iterator[tuple[str, str]]:
    topology, merged = report.topology, report.merged
    sizes = ((report.verts, "vertex"), (report.faces, "face"), (topology.edges, "edge"))
    yield "size", ", ".join(_count(count, name) for count, name in sizes)
    yield from _bounds_rows(report.bounds)
    volume = "none: not a closed manifold" if report.volume is None else f"{report.volume:.6g}"
    yield "area, volume", f"{report.area:.6g}, {volume}"
    lengths = (report.edge_length_min, report.edge_length_mean, report.edge_length_max)
    yield "edge lengths", f"{_spaced(lengths, ' .. ')} (min, mean, max), spread {report.edge_length_spread:.3f}"
    bend, alone = f"{report.mean_dihedral_deg:.3g} degrees on average", "none: no two faces share an edge"
    yield "bend at edges", alone if math.isnan(report.mean_dihedral_deg) else bend
    yield "colours", report.colors
    for material in report.materials:
        yield "material", _material_text(material)
    if report.uv_range is not None:
        (u0, u1), (v0, v1) = report.uv_range
        outside = f", {report.uvs_outside:,} outside [0, 1]" if report.uvs_outside else ""
        yield "texture coordinates", f"{report.uvs:,}, u {u0:.3g} .. {u1:.3g}, v {v0:.3g} .. {v1:.3g}{outside}"
    yield "stored normals", report.normals + (f", {report.wrong_normals:,} wrong" if report.wrong_normals else "")
    yield from _topology_rows(topology)
    flaws = {
        "not finite": report.not_finite_verts,
        "at shared places": report.duplicate_verts,
        "unused": report.unreferenced_verts,
    }
    yield "vertices", ", ".join(f"{count:,} {name}" for name, count in flaws.items())
    yield "faces", f"{report.degenerate_faces:,} degenerate, {report.duplicate_faces:,} duplicate"
    if merged is not None:
        yield "with shared places merged", f"{merged.verts:,} vertices, {merged.edges:,} edges"
        yield from _topology_rows(merged)


def _topology_rows(topology: Topology) -> Iterator[tuple[str, str]]:
    yield "  components", f"{topology.components:,}, faces: {_sizes(topology.component_faces, topology.components)}"
    genus = "" if topology.genus is None else f", genus {topology.genus}"
    yield "  Euler characteristic", f"{topology.euler_characteristic}{genus}"
    holes = f", edges: {_sizes(topology.hole_edges, topology.holes)}" if topology.holes else ""
    yield "  holes", f"{topology.holes:,}{holes}"
    yield (
        "  non-manifold",
        f"{_count(topology.non_manifold_edges, 'edge')}, {_count(topology.non_manifold_verts, 'vertex')}",
    )
    yield (
        "  winding",
        f"{_count(topology.inconsistent_edges, 'edge')} where faces disagree, "
        f"{_count(topology.flipped_faces, 'flipped face')}, {_count(topology.inward_faces, 'inside-out face')}",
    )
    yield "  self-intersections", f"{_count(topology.self_intersections, 'pair')} of faces"


def _cloud_rows(report: CloudReport) -> Iterator[tuple[str, str]]:
    yield "size", _count(report.points, "point")
    yield from _bounds_rows(report.bounds)
    if report.spacing_median is not None:
        spacing = (report.spacing_min, report.spacing_median, report.spacing_mean, report.spacing_max)
        yield "nearest neighbour", f"{_spaced(spacing, ' .. ')} (min, median, mean, max)"
    yield "points", f"{report.not_finite_points:,} not finite, {report.duplicate_points:,} at shared places"
    yield "normals", f"{report.normals:,}, {report.normals_not_unit:,} not of length 1" if report.normals else "none"
    if report.feature_range is not None:
        low, high = report.feature_range
        name = "colours" if report.features in (3, 4) else "features"
        yield name, f"{report.features} channels, {low:.3g} .. {high:.3g}"


def _bounds_rows(bounds: Bounds | None) -> Iterator[tuple[str, str]]:
    if bounds is not None:
        yield "from, to", f"({_spaced(bounds.low)}), ({_spaced(bounds.high)})"
        yield "extent", f"{_spaced(bounds.extent, ' x ')}, diagonal {bounds.diagonal:.4g}; {bounds.scale_guess}"


def _material_text(material: dict[str, Any]) -> str:
    color, size, faces = (material[key] for key in ("diffuse_color", "image_size_px", "faces"))
    parts = [repr(material["name"])] if material["name"] else []
    parts += [f"image {size[0]} x {size[1]} px"] if size else []
    parts += [f"diffuse ({_spaced(color)})"] if color else []
    parts += [_count(faces, "face")] if faces is not None else []
    return ", ".join(parts)


def _spaced(values: Any, between: str = ", ") -> str:
    return between.join(f"{value:.4g}" for value in values)


def _sizes(sizes: tuple[int, ...], count: int) -> str:
    return ", ".join(f"{size:,}" for size in sizes) + (", ..." if count > len(sizes) else "")
