"""Forms of flow, of solids in it and of meshes that move: functions of fields that create none."""
