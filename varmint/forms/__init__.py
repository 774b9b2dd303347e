"""Forms of flow, of solids in it and of meshes that move: functions of fields that create none."""

from tigar_x.front import modules_of

__all__ = modules_of(__name__)
