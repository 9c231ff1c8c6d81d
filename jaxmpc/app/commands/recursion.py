"""The command `jaxmpc recursion`."""

import time

from jaxmpc.app import config as configs
from jaxmpc.app.commands.sweep import map_robot_into
from jaxmpc.app.options.recursion import RecursionOptions
from jaxmpc.app.options.shared import (
    arguments,
    at_least,
    given_options,
    print_table,
    refuse,
)
from jaxmpc.files import open_folder, require_new
from jaxmpc.recursion import recursive_feasibility, smallest_horizon
from jaxmpc.recursion.report import FILES, save_report
from jaxmpc.robot_maps.stored_sweep import sweep_robot


class Recursion(RecursionOptions):
    """The command: its options, and `run`."""

    def run(self) -> None:
        """Examine the claims, write the files, print the table.

        Raises ValueError for options and files that make no sense.
        """
        begun = time.perf_counter()
        if self.robot is not None:
            self.map_robot(self.robot)
            return
        given = {"axes": self.axes, "fixed": self.fixed, "resume": self.resume}
        refuse(given, None, "It is for maps of robots")
        keys = "horizon terminal steps grid lower upper regions seconds".split()
        config = configs.load(self.config, given_options(self, *keys), "recursion")
        if self.smallest is not None:
            configs.require_horizon(config, "--smallest", self.smallest)
        mpc, settings = config.build_mpc(), config.recursion
        asked = any(v is not None for v in (settings.grid, settings.lower, settings.upper))
        states = configs.recursion_states(config) if asked else None
        require_new([self.output / name for name in FILES], self.overwrite)
        open_folder(self.output)
        print(f"{config.name}: horizon {mpc.horizon} -> {self.output}")
        seconds = settings.seconds / (1 if self.smallest is None else 2)
        report = recursive_feasibility(
            mpc,
            states,
            steps=settings.steps,
            search=self.search,
            max_regions=settings.regions,
            seconds=seconds,
            progress=True,
            **config.references(),
        )
        rows, least = [], None
        if self.smallest is not None:
            least = smallest_horizon(
                mpc,
                self.smallest,
                max_regions=settings.regions,
                seconds=seconds,
                progress=True,
                **config.references(),
            )
            rows.append(("smallest horizon", str(least)))
        save_report(self.output, report, config.to_dict("recursion"), least)
        files = ["summary.json", "recursion.npz"]
        if mpc.dimension == 2:
            from jaxmpc.app.plots.maps import draw_recursion
            from jaxmpc.app.plots.style import save

            try:
                save(draw_recursion(report), self.output / "recursion.png", config.name)
                files.append("recursion.png")
            except ValueError as error:
                rows.append(("picture", f"none: {error}"))
        print(report)
        if config.references():
            rows.append(("set-point", "the law is that of [reference]"))
        rows.append(("total", f"{time.perf_counter() - begun:.2f} s with set-up and files"))
        rows.append(("files", " ".join(str(self.output / name) for name in files)))
        print_table(rows, 20)

    def map_robot(self, robot: str) -> None:
        """Make the map of --robot. Raises ValueError for options that do not go with it."""
        given = {"config": self.config, "smallest": self.smallest, "regions": self.regions}
        refuse(given, robot, "Claims about all states are those of a linear problem")
        at_least(1).check("--horizon", self.horizon)
        at_least(1).check("--steps", self.steps)
        options = arguments(self, sweep_robot, leave=("robot", "seconds", "steps"))
        if self.seconds is not None:
            options["search_seconds"] = self.seconds
        steps = 100 if self.steps is None else self.steps
        map_robot_into(robot, self.output, claim="recursion", steps=steps, **options)
