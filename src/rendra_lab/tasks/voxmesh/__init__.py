"""VoxMesh: the mesh of one object from one picture, with all of its sides."""
