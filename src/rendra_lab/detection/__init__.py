"""Objects in photographs: boxes, masks and shapes, and how well they were found. Of Mask R-CNN and Mesh R-CNN."""
