"""All buildings by name."""

from collections.abc import Callable

from .floorplans import FloorPlan, corridor, hall, lab, room, warehouse
from .large_places import arena, site, site_next_day, tunnel
from .odd_places import orchard, rotunda, shed, supermarket

PLANS: dict[str, Callable[[], FloorPlan]] = {
    p.__name__: p for p in (
        hall, corridor, lab, warehouse, room, arena, tunnel, site, site_next_day, rotunda, orchard, supermarket, shed,
    )
}  # fmt: skip
