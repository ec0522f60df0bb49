"""What a mesh file holds: `python scripts/tour/files.py [FILE.obj]`.

An OBJ file names corners by numbers that start at 1, or by negative ones that count back from the end; a face may
have more than three corners, and each corner its own texture coordinate and normal. `load_obj` turns all of it into
triangles and indices that start at 0: vertices, `Faces` and `Properties`. A PLY file is simpler: vertices and faces.
"""

import sys
import tempfile
from pathlib import Path

import torch

from rendra.io import load_obj, load_ply, save_obj, save_ply

OBJ = """mtllib house.mtl
v 0 0 0
v 2 0 0
v 2 2 0
v 0 2 0
v 1 3 0
vt 0 0
vt 1 0
vt 1 1
vt 0 1
vn 0 0 1
usemtl wall
f 1/1/1 2/2/1 3/3/1 4/4/1
usemtl roof
f -2//1 -3//1 -1//1
"""
MTL = "newmtl wall\nKd 0.9 0.8 0.6\nnewmtl roof\nKd 0.7 0.2 0.1\nNs 20\n"


def main(file: str | None = None) -> None:
    """Reads the user's OBJ file, or a house of one square wall and a triangular roof."""
    with tempfile.TemporaryDirectory() as folder:
        if file is None:
            (Path(folder) / "house.obj").write_text(OBJ)
            (Path(folder) / "house.mtl").write_text(MTL)
        path = Path(file or f"{folder}/house.obj")
        verts, faces, properties = load_obj(path)
        print(f"{path.name}: {len(verts)} vertices, {len(faces.verts_idx)} triangles (a polygon becomes a fan)")
        # Faces: indices into the lists of the file, -1 where a corner has none
        show("faces.verts_idx", faces.verts_idx)
        show("faces.textures_idx", faces.textures_idx)
        show("faces.normals_idx", faces.normals_idx)
        show("faces.materials_idx", faces.materials_idx)
        # Properties: what these indices point at; None where the file has nothing
        show("properties.verts_uvs", properties.verts_uvs)
        show("properties.normals", properties.normals)
        for name, colours in (properties.material_colors or {}).items():
            print(f"material {name}:", {key: rounded(value) for key, value in colours.items()})
        print("texture images:", list(properties.texture_images or {}) or "none")
        save_obj(Path(folder) / "copy.obj", verts, faces.verts_idx, decimal_places=12)  # else 6
        again, _, _ = load_obj(Path(folder) / "copy.obj")
        print(f"written as OBJ and read again: same={torch.allclose(again, verts)}")
        save_ply(Path(folder) / "copy.ply", verts, faces.verts_idx)  # binary; ascii=True for text
        again, faces_again = load_ply(Path(folder) / "copy.ply")
        print(f"written as PLY and read again: same={torch.equal(again, verts)}, {len(faces_again)} triangles")


def show(name: str, rows: torch.Tensor | None) -> None:
    """A name, the shape and the first rows."""
    print(f"{name}: none" if rows is None else f"{name} {tuple(rows.shape)}: {rounded(rows[:3])}")


def rounded(values: torch.Tensor) -> list:
    """Numbers with three digits behind the point."""
    return values.double().mul(1000).round().div(1000).tolist() if values.is_floating_point() else values.tolist()


if __name__ == "__main__":
    try:
        main(*sys.argv[1:2])
    except (OSError, ValueError) as error:  # ValueError: MeshFormatError, with file and line
        sys.exit(f"files.py: {error}")
