"""GeoDiff for ComfyUI: copy this folder to ``ComfyUI/custom_nodes/geodiff``, and see its README."""

from .nodes import NODE_CLASS_MAPPINGS, NODE_DISPLAY_NAME_MAPPINGS

__all__ = ["NODE_CLASS_MAPPINGS", "NODE_DISPLAY_NAME_MAPPINGS"]
