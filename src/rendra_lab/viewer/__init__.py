"""A 3-D view of meshes, point clouds and cameras for a web page: WebGL 2 of our own, no network, no build step.

`scene_payload` packs geometry into a dictionary for JSON; `viewer_assets` is the style and the program that draws it:
`RendraViewer.mount(element, payload)`.
"""

from rendra_lab.viewer.page import payload_json, viewer_assets, viewer_page
from rendra_lab.viewer.scene import Limits, scene_payload

__all__ = ["Limits", "payload_json", "scene_payload", "viewer_assets", "viewer_page"]
