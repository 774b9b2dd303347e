"""What divides a mesh in the plane or in space, but for where curves and surfaces see the flow."""

from collections.abc import Callable

from dolfinx import fem

from coudalfish.surface.cut_cells import CutCells, SideWeights
from coudalfish.surface.enriched import Enriching, Enrichment
from coudalfish.surface.facets import FacetWeights
from tigar_x import compat
from tigar_x.compat import FloatArray, IntArray


class DividedMesh:
    """A mesh of triangles or tetrahedra, see :class:`coudalfish.sides.sided_fluid.Dividing`.

    Args:
        space: scalar linear space of one component of the velocity.
        weights: discontinuous space of the weights of sides.
        walls: the same of those on the boundary, of that degree or one more.
        size: of cells near the surface; unit: length.
        kinked: whether velocities are kinked; pressures always jump.
    """

    def __init__(
        self,
        space: fem.FunctionSpace,
        weights: fem.FunctionSpace,
        walls: fem.FunctionSpace,
        size: float,
        *,
        kinked: bool,
    ) -> None:
        self._space, self._size, self._kinked = space, size, kinked
        self._enriching = Enriching(space, kinked=kinked)
        degree = compat.lagrange_degree(weights)
        self._weights, self._walls = SideWeights(degree, compat.node_points(weights)), FacetWeights(walls, degree)

    @property
    def nothing(self) -> Enrichment:
        """See there."""
        return self._enriching.nothing

    def suits(self, load: Callable[[], FloatArray]) -> bool:
        """See there."""
        return True

    def weights(self, cut: CutCells) -> FloatArray:
        """See there."""
        return self._weights(cut)

    def on_walls(self, cut: CutCells) -> tuple[IntArray, FloatArray]:
        """See there."""
        return self._walls(cut)
