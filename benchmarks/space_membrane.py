"""The manufactured membrane of ``demos/manufactured.py`` as a scene for any setting, see ``space.py``."""

from dataclasses import dataclass

from load import load_demo
from scene import Found, Setting
from space import IN_SPACE

from coudalfish.problems import manufactured as problem
from tigar_x.run.progress import Stopwatch


@dataclass(frozen=True)
class Membrane:
    """A membrane across tetrahedra that moves as an exact solution says, under a jump of pressure of one.

    Attributes:
        level: of refinement: 3 * 2^level cells along a side.
        curved: whether the membrane is curved and moves differently everywhere; or all is plane, in one layer of cells.
        dt_factor: time step relative to the published one.
    """

    level: int = 2
    curved: bool = False
    dt_factor: float = 2.0

    def run(self, setting: Setting = IN_SPACE) -> Found:
        """March to the end.

        Figures: true errors by the names of their norms, "L2_u", "H1_u", "L2_p", "L2_y", "H1_y".
        """
        data, watch = problem.data_of(3, curved=self.curved), Stopwatch()
        steps = max(1, round(2 * problem.cells_per_side(self.level) / self.dt_factor))
        more = {"data": data, "immersed": setting.immersed, "projected": False}
        flow, _, fsi = load_demo("manufactured").build(
            3, self.level, steps, setting.options, setting.flow.solver, **more
        )
        reports = []
        for _ in range(steps):
            with watch:
                reports.append(fsi.takeStep())
        return Found(problem.errors(fsi, data, data.T, 8), tuple(reports), watch, flow.unknowns)
