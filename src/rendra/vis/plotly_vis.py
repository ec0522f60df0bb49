"""Interactive figures of meshes, point clouds, cameras and rays, in a notebook or a browser.

Needs plotly, an extra: `pip install 'rendra[view]'`. The names and arguments are those of `pytorch3d.vis.plotly_vis`.
A trace is one named thing in a subplot. Axes are those of the world, +y up on the screen; all three are equally
long, and the box round everything in a subplot lies in the middle of the picture.
"""

import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from types import SimpleNamespace
from typing import Any, NamedTuple

import torch
from torch import Tensor

from rendra.renderer.camera_utils import camera_to_eye_at_up
from rendra.renderer.cameras import CamerasBase
from rendra.renderer.mesh.textures import TexturesVertex
from rendra.structures.meshes import Meshes, join_meshes_as_scene
from rendra.structures.pointclouds import Pointclouds

Struct = Any  # Meshes, Pointclouds, CamerasBase, or rays: anything with origins, directions and lengths
_Viewpoint = tuple[Tensor, Tensor, Tensor]  # eye, a point ahead, up; (3,) each

_SETTINGS = ("axis_args", "lighting", "xaxis", "yaxis", "zaxis")
_DEFAULT_EYE = {"x": 0.9, "y": 0.6, "z": 1.9}  # in lengths of an axis from the middle of the box
_MARGIN = 1.05
_ROW_PX = 480


class AxisArgs(NamedTuple):
    """How all three axes of a plot look: a bare white space unless told otherwise. See plotly's `layout.scene.xaxis`.

    Attributes:
        showgrid, zeroline, showline: which lines are drawn.
        ticks: "", "inside" or "outside".
        showticklabels, showaxeslabels: which texts are drawn.
        backgroundcolor: of the box's walls.
    """

    showgrid: bool = False
    zeroline: bool = False
    showline: bool = False
    ticks: str = ""
    showticklabels: bool = False
    backgroundcolor: str = "#fff"
    showaxeslabels: bool = False


class Lighting(NamedTuple):
    """How meshes are lit; see plotly's `mesh3d.lighting`.

    Attributes:
        ambient, diffuse, fresnel, specular, roughness: strengths.
        facenormalsepsilon, vertexnormalsepsilon: lengths below which normals count as zero.
    """

    ambient: float = 0.8
    diffuse: float = 1.0
    fresnel: float = 0.0
    specular: float = 0.0
    roughness: float = 0.5
    facenormalsepsilon: float = 1e-6
    vertexnormalsepsilon: float = 1e-12


@dataclass(frozen=True)
class _Style:
    """The numbers that `plot_scene` takes, handed on together."""

    camera_scale: float
    pointcloud_max_points: int
    pointcloud_marker_size: int
    raybundle_max_rays: int
    raybundle_max_points_per_ray: int
    raybundle_ray_point_marker_size: int
    raybundle_ray_line_width: int
    lighting: Lighting


def get_camera_wireframe(scale: float = 0.3) -> Tensor:
    """One unbroken line that draws a camera: a pyramid with its tip in the centre, which opens to where it looks.

    A triangle on the upper side of the base tells up, a stroke along the view axis tells the direction.

    Args:
        scale: of the whole; the base lies 2 * scale ahead of the centre.

    Returns:
        (P, 3) points in view space (+x left, +y up, +z ahead), to be joined in order.
    """
    depth, half_width, half_height, peak = 2.0, 1.0, 0.75, 1.0
    tip, ahead = (0.0, 0.0, 0.0), (0.0, 0.0, 1.5)
    left_top, right_top = (half_width, half_height, depth), (-half_width, half_height, depth)
    left_bottom, right_bottom = (half_width, -half_height, depth), (-half_width, -half_height, depth)
    mark = (0.0, peak, depth)
    path = [ahead, tip, left_top, mark, right_top, tip, left_bottom, left_top, right_top, right_bottom, tip]
    path += [right_bottom, left_bottom]
    return scale * torch.tensor(path)


def plot_scene(
    plots: Mapping[str, Mapping[str, Struct]],
    *,
    viewpoint_cameras: CamerasBase | None = None,
    ncols: int = 1,
    camera_scale: float = 0.3,
    pointcloud_max_points: int = 20000,
    pointcloud_marker_size: int = 1,
    raybundle_max_rays: int = 20000,
    raybundle_max_points_per_ray: int = 1000,
    raybundle_ray_point_marker_size: int = 1,
    raybundle_ray_line_width: int = 1,
    **kwargs: Any,
) -> Any:
    """Draw subplots of traces.

    Args:
        plots: {title of a subplot: {name of a trace: Meshes, Pointclouds, cameras or rays}}. All elements of a
            batch belong to one trace. Rays are anything with `origins` (..., 3), `directions` (..., 3) and
            `lengths` (..., P). Colours are vertex colours, or a face's texture at its middle, and the features
            of points if they are RGB or RGBA in [0, 1].
        viewpoint_cameras: from where the subplots are seen at first; one for all, or one for each. A batch of
            another size is not used, with a warning.
        ncols: subplots in a row.
        camera_scale: of the wireframes that show cameras.
        pointcloud_max_points: of larger clouds as many points are drawn, evenly chosen.
        pointcloud_marker_size: in pixels.
        raybundle_max_rays: of more rays as many are drawn, evenly chosen.
        raybundle_max_points_per_ray: likewise for the points of a ray.
        raybundle_ray_point_marker_size: in pixels.
        raybundle_ray_line_width: in pixels.
        **kwargs: `axis_args`, an AxisArgs for all axes; `xaxis`, `yaxis`, `zaxis`, mappings of what plotly's scene
            takes for one axis; `lighting`, a Lighting for meshes. Others are ignored with a warning.

    Returns:
        A `plotly.graph_objects.Figure`.

    Raises:
        ImportError: plotly is missing.
        ValueError: a trace that is none of these, or an empty or malformed `plots`.
    """
    go, subplots = _plotly()
    _check_plots(plots, ncols, kwargs)
    style = _Style(
        camera_scale,
        pointcloud_max_points,
        pointcloud_marker_size,
        raybundle_max_rays,
        raybundle_max_points_per_ray,
        raybundle_ray_point_marker_size,
        raybundle_ray_line_width,
        kwargs.get("lighting", Lighting()),
    )
    rows = -(-len(plots) // ncols)
    figure = subplots.make_subplots(
        rows=rows,
        cols=ncols,
        specs=[[{"type": "scene"}] * ncols] * rows,
        subplot_titles=list(plots),
    )
    viewpoints = _viewpoints(viewpoint_cameras, len(plots))
    for number, traces in enumerate(plots.values()):
        place = {"row": number // ncols + 1, "col": number % ncols + 1}
        drawn = [_trace(go, name, struct, style) for name, struct in traces.items()]
        for trace, _ in drawn:
            figure.add_trace(trace, **place)
        figure.update_scenes(_scene([points for _, points in drawn], viewpoints[number], kwargs), **place)
    figure.update_layout(height=_ROW_PX * rows, margin={"l": 0, "r": 0, "t": 40, "b": 0})
    return figure


def plot_batch_individually(
    batched_structs: Struct | Sequence[Struct] | Mapping[str, Struct],
    *,
    viewpoint_cameras: CamerasBase | None = None,
    ncols: int = 1,
    extend_struct: bool = True,
    subplot_titles: Sequence[str] | None = None,
    **kwargs: Any,
) -> Any:
    """Draw each element of a batch in a subplot of its own.

    Args:
        batched_structs: Meshes, Pointclouds, cameras or rays; a list of them, or a mapping that names them. All
            must have the same number of elements, or one.
        viewpoint_cameras: see `plot_scene`.
        ncols: subplots in a row.
        extend_struct: what has one element goes into every subplot, otherwise into the first.
        subplot_titles: one for each element; None for "scene 1" and so on.
        **kwargs: as for `plot_scene`.

    Returns:
        A `plotly.graph_objects.Figure`; None, with a warning, if there is nothing to plot.

    Raises:
        ImportError: plotly is missing.
        ValueError: batches of different sizes, or not one title for each element.
    """
    named = _named(batched_structs)
    sizes = {name: _batch_size(struct) for name, struct in named.items()}
    count = max(sizes.values(), default=0)
    if count == 0:
        warnings.warn("No structs to plot", stacklevel=2)
        return None
    if any(size not in (1, count) for size in sizes.values()):
        raise ValueError(f"all batches must have as many elements as each other, or one; got {sizes}")
    titles = [f"scene {i + 1}" for i in range(count)] if subplot_titles is None else list(subplot_titles)
    if len(titles) != count:
        raise ValueError(f"expected {count} subplot_titles, one for each element of the batch; got {len(titles)}")
    if len(set(titles)) != count:
        raise ValueError(f"subplot_titles must differ from each other, got {titles}")
    plots: dict[str, dict[str, Struct]] = {title: {} for title in titles}
    for name, struct in named.items():
        for i, title in enumerate(titles):
            if sizes[name] == count:
                plots[title][name] = _element(struct, i)
            elif extend_struct or i == 0:
                plots[title][name] = _element(struct, 0)
    return plot_scene(plots, viewpoint_cameras=viewpoint_cameras, ncols=ncols, **kwargs)


def _plotly() -> tuple[Any, Any]:
    try:
        from plotly import graph_objects, subplots
    except ImportError as error:
        raise ImportError("interactive figures need plotly: pip install 'rendra[view]'") from error
    return graph_objects, subplots


def _check_plots(plots: Any, ncols: int, settings: dict[str, Any]) -> None:
    if not isinstance(plots, Mapping) or not all(isinstance(traces, Mapping) for traces in plots.values()):
        raise ValueError("plots must be {title of a subplot: {name of a trace: what to draw}}")
    if not plots:
        raise ValueError("plots must have at least one subplot, got none")
    if not (isinstance(ncols, int) and ncols >= 1):
        raise ValueError(f"ncols must be a whole number of at least 1, got {ncols!r}")
    unknown = sorted(set(settings) - set(_SETTINGS))
    if unknown:
        warnings.warn(f"ignored: {', '.join(unknown)}; known are {', '.join(_SETTINGS)}", stacklevel=3)


def _is_rays(struct: Any) -> bool:
    return all(isinstance(getattr(struct, name, None), Tensor) for name in ("origins", "directions", "lengths"))


def _trace(go: Any, name: str, struct: Struct, style: _Style) -> tuple[Any, Tensor]:
    """A plotly trace, and the points (P, 3) that have to be in sight."""
    if isinstance(struct, Meshes):
        return _mesh_trace(go, name, struct, style)
    if isinstance(struct, Pointclouds):
        return _points_trace(go, name, struct, style)
    if isinstance(struct, CamerasBase):
        return _cameras_trace(go, name, struct, style)
    if _is_rays(struct):
        return _rays_trace(go, name, struct, style)
    raise ValueError(
        f"struct {name!r} is not a Cameras, Meshes, Pointclouds or RayBundle object, but {type(struct).__name__}"
    )


def _mesh_trace(go: Any, name: str, meshes: Meshes, style: _Style) -> tuple[Any, Tensor]:
    scene = join_meshes_as_scene(meshes, include_textures=False) if len(meshes) != 1 else meshes
    verts, faces = _plain(scene.verts_packed()), scene.faces_packed().detach().cpu()
    x, y, z = verts.unbind(1)
    i, j, k = faces.unbind(1)
    trace = go.Mesh3d(
        **{"x": x.numpy(), "y": y.numpy(), "z": z.numpy(), "i": i.numpy(), "j": j.numpy(), "k": k.numpy()},
        **_mesh_colors(meshes),
        lighting=style.lighting._asdict(),
        name=name,
        showlegend=True,
    )
    return trace, verts[faces.unique()]


def _mesh_colors(meshes: Meshes) -> dict[str, Any]:
    """What plotly needs to know of a texture: vertex colours, or one colour a face."""
    textures = meshes.textures
    if textures is None or not len(meshes.faces_packed()):
        return {}
    if isinstance(textures, TexturesVertex):
        colors = textures.verts_features_packed()
        return {"vertexcolor": _css(colors)} if colors.shape[-1] in (3, 4) else {}
    faces = torch.arange(len(meshes.faces_packed()), device=meshes.device)
    middles = SimpleNamespace(
        pix_to_face=faces[None, None, :, None],
        bary_coords=torch.full((1, 1, len(faces), 1, 3), 1 / 3, device=meshes.device),
    )
    colors = meshes.sample_textures(middles)[0, 0, :, 0]
    return {"facecolor": _css(colors)} if colors.shape[-1] in (3, 4) else {}


def _points_trace(go: Any, name: str, clouds: Pointclouds, style: _Style) -> tuple[Any, Tensor]:
    points, features = clouds.points_packed(), clouds.features_packed()
    chosen = _evenly(len(points), style.pointcloud_max_points, points.device)
    points = _plain(points[chosen])
    marker: dict[str, Any] = {"size": style.pointcloud_marker_size}
    if features is not None and features.shape[-1] in (3, 4):
        marker["color"] = _css(features[chosen])
    x, y, z = points.unbind(1)
    return go.Scatter3d(x=x.numpy(), y=y.numpy(), z=z.numpy(), mode="markers", marker=marker, name=name), points


def _cameras_trace(go: Any, name: str, cameras: CamerasBase, style: _Style) -> tuple[Any, Tensor]:
    to_world = cameras.get_world_to_view_transform().inverse()
    wireframe = get_camera_wireframe(style.camera_scale).to(cameras.device)
    lines = _plain(to_world.transform_points(wireframe)).reshape(-1, *wireframe.shape)  # (N, P, 3)
    x, y, z = _broken(lines).unbind(1)
    trace = go.Scatter3d(x=x.numpy(), y=y.numpy(), z=z.numpy(), mode="lines", line={"width": 2}, name=name)
    return trace, lines.flatten(0, 1)


def _rays_trace(go: Any, name: str, rays: Any, style: _Style) -> tuple[Any, Tensor]:
    """Rays from their first to their last point, and the points on them."""
    lengths = rays.lengths.flatten(0, -2)  # (R, P)
    origins, directions = (side.reshape(-1, 3) for side in (rays.origins, rays.directions))
    chosen = _evenly(len(lengths), style.raybundle_max_rays, lengths.device)
    samples = _evenly(lengths.shape[1], style.raybundle_max_points_per_ray, lengths.device)
    along = lengths[chosen][:, samples, None]
    points = _plain(origins[chosen, None] + along * directions[chosen, None])  # (R, P, 3)
    x, y, z = _broken(points).unbind(1)
    trace = go.Scatter3d(
        x=x.numpy(),
        y=y.numpy(),
        z=z.numpy(),
        mode="lines+markers",
        marker={"size": style.raybundle_ray_point_marker_size},
        line={"width": style.raybundle_ray_line_width},
        name=name,
    )
    return trace, points.flatten(0, 1)


def _plain(points: Tensor) -> Tensor:
    return points.detach().cpu().float()


def _broken(lines: Tensor) -> Tensor:
    """Lines (N, P, 3) as one list of points with a gap after each. (N * (P + 1), 3)"""
    gap = lines.new_full((len(lines), 1, 3), torch.nan)
    return torch.cat([lines, gap], dim=1).flatten(0, 1)


def _evenly(count: int, limit: int, device: torch.device) -> Tensor:
    """Numbers of `limit` out of `count` things, or of all if there are no more."""
    if count <= limit:
        return torch.arange(count, device=device)
    return torch.arange(limit, device=device) * count // limit


def _css(colors: Tensor) -> list[str]:
    """RGB or RGBA in [0, 1] in the words of a style sheet."""
    colors = colors.detach().cpu().float().nan_to_num(0.0).clamp(0, 1)
    values = colors[:, :3].mul(255).round().int().tolist()
    if colors.shape[1] == 3:
        return [f"rgb({r},{g},{b})" for r, g, b in values]
    alphas = colors[:, 3].tolist()
    return [f"rgba({r},{g},{b},{a:.3g})" for (r, g, b), a in zip(values, alphas, strict=True)]


def _viewpoints(cameras: CamerasBase | None, count: int) -> list[_Viewpoint | None]:
    """Eye, a point ahead, and up, for each subplot."""
    if cameras is None:
        return [None] * count
    eyes, ats, ups = (_plain(side) for side in camera_to_eye_at_up(cameras.get_world_to_view_transform()))
    found: list[_Viewpoint | None] = list(zip(eyes, ats, ups, strict=True))
    if len(found) not in (1, count):
        warnings.warn(
            f"viewpoint_cameras ignored: {len(found)} cameras for {count} subplots; give one, or one for each",
            stacklevel=4,
        )
        return [None] * count
    return found * count if len(found) == 1 else found


def _scene(extents: list[Tensor], viewpoint: _Viewpoint | None, settings: Mapping[str, Any]) -> dict[str, Any]:
    """Plotly's scene: axes of one length round all points, and the place from where it is seen."""
    middle, length = _cube(extents)
    common = settings.get("axis_args", AxisArgs())._asdict()
    scene: dict[str, Any] = {"aspectmode": "cube", "camera": _camera(viewpoint, middle, length)}
    for name, centre in zip(("xaxis", "yaxis", "zaxis"), middle.tolist(), strict=True):
        bounds = [centre - length / 2, centre + length / 2]
        scene[name] = {**common, "range": bounds, **settings.get(name, {})}
    return scene


def _cube(extents: list[Tensor]) -> tuple[Tensor, float]:
    """Middle (3,) and side of the smallest upright cube round all finite points, with a margin."""
    points = torch.cat([*extents, torch.zeros(0, 3)])
    points = points[points.isfinite().all(1)]
    if not len(points):
        return torch.zeros(3), 2.0
    low, high = points.amin(0), points.amax(0)
    side = float((high - low).amax()) * _MARGIN
    return (low + high) / 2, side if side > 0 else 1.0


def _camera(viewpoint: _Viewpoint | None, middle: Tensor, length: float) -> dict[str, Any]:
    """Plotly's camera, which counts in lengths of an axis from the middle of the box.

    It turns about `center`: the point of the view axis that is nearest to the middle, if that lies ahead.
    """
    if viewpoint is None:
        return {"eye": dict(_DEFAULT_EYE), "center": _xyz(torch.zeros(3)), "up": {"x": 0, "y": 1, "z": 0}}
    eye, at, up = viewpoint
    eye, ahead = (eye - middle) / length, at - eye
    reach = float(-(eye * ahead).sum())
    center = eye + ahead * (reach if reach > 0 else 1.0)
    return {"eye": _xyz(eye), "center": _xyz(center), "up": _xyz(up)}


def _xyz(vector: Tensor) -> dict[str, float]:
    return dict(zip("xyz", vector.tolist(), strict=True))


def _named(structs: Any) -> dict[str, Struct]:
    """What to draw, with a name for each."""
    if isinstance(structs, Mapping):
        return dict(structs)
    if not isinstance(structs, (list, tuple)) or _is_rays(structs):  # rays may be a named tuple
        structs = [structs]
    return {f"trace{i + 1}": struct for i, struct in enumerate(structs)}


def _batch_size(struct: Struct) -> int:
    if _is_rays(struct):
        return len(struct.lengths)
    try:
        return len(struct)
    except TypeError as error:
        raise ValueError(f"expected Cameras, Meshes, Pointclouds or rays, got {type(struct).__name__}") from error


def _element(struct: Struct, index: int) -> Struct:
    """One element of a batch, as a batch of one."""
    if _is_rays(struct):
        parts = {name: getattr(struct, name)[index : index + 1] for name in ("origins", "directions", "lengths")}
        return SimpleNamespace(**parts)
    return struct[index]
