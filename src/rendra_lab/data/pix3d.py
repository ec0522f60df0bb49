"""Pix3D: photographs with outlines and models of the furniture in them, as its authors lay it out.

Sun et al., "Pix3D: Dataset and Methods for Single-Image 3D Shape Modeling", CVPR 2018, and its readme; the divisions
are those of Gkioxari, Malik and Johnson, "Mesh R-CNN", ICCV 2019. What a folder holds, and a writer must write:

- `img/CLASS/NAME.png|jpg`, `mask/CLASS/NAME.png` (bright where the object is seen, as large as the picture),
  `model/CLASS/NAME/model.obj` (any axes, any unit), `model/CLASS/NAME/voxel.mat`.
- `pix3d.json`, a list with an entry for each object. Objects of one picture are entries with one `img`:
  - `img`, `mask`, `model`, `voxel`: paths within the folder. `category`: one of CLASSES.
  - `img_size`: [width, height]. `bbox`: [x0, y0, x1, y1], pixels, edges as in `rendra_lab.detection.records`.
  - `rot_mat` (3 rows) and `trans_mat` [x, y, z]: R and t. A vertex v of the model is at R v + t before a camera that
    stands in the origin and looks along +z: x grows to the left of the picture, y upwards.
    Hence OpenCV's axes are diag(-1, -1, 1) (R v + t).
  - `focal_length`: in mm on a sensor 32 mm wide, so that f = focal_length * width / 32 pixels, and the middle of the
    picture is the camera's. Or `K`: [f, px, py] in pixels, which counts where it is there, and keeps all digits.
  - `truncated`, `occluded`, `slightly_occluded`, `img_source`, `model_source` and more are not read.
- `voxel.mat`: variable `voxel`, (V, V, V) uint8 or bool, indexed [i, j, k]: i grows with the model's x, j against its
  z, k with its y. The grid's cube is about the model: published files leave open how. They are laid so that the boxes
  about the filled cells and about the model have one middle and one longest side. Where an entry has
  `voxel_cube`: [x, y, z, side], the cube's middle and side in the model's coordinates, it is that (ours; written).
- `pix3d_s1_train.json`, `pix3d_s1_test.json`, `pix3d_s2_*.json` (Mesh R-CNN's): `images` (id, file_name, width,
  height), `annotations` (id, image_id, category_id, bbox [x, y, width, height], segmentation: path of the mask, model,
  voxel, K, rot_mat, trans_mat, perhaps voxel_cube, all as above) and `categories` (id from 1, name). Ours writes
  `pix3d_s1_val.json` and `pix3d_s2_val.json` too; where there is none, every tenth picture of training is validation.
"""
