"""Files of meshes and point clouds: OBJ, PLY, glTF, OFF, STL, XYZ, and formats of one's own."""

from rendra.io.errors import MeshFormatError
from rendra.io.obj_io import load_obj, load_objs_as_meshes, save_obj
from rendra.io.pluggable import IO
from rendra.io.ply_io import load_ply, save_ply

__all__ = ["IO", "MeshFormatError", "load_obj", "load_objs_as_meshes", "load_ply", "save_obj", "save_ply"]
