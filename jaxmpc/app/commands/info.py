"""The command `jaxmpc info`."""

import dataclasses
import io
from typing import Any

from jaxmpc.app import config as configs
from jaxmpc.app.commands import report as page
from jaxmpc.app.commands.outcome import Outcome
from jaxmpc.app.options.info import InfoOptions
from jaxmpc.app.options.shared import (
    given_options,
)
from jaxmpc.checks import fail
from jaxmpc.files import as_json
from jaxmpc.workflow.offline_checks import OfflineReport, offline_report


class Info(InfoOptions):
    """The command: its options, and `run`."""

    def run(self) -> Outcome:
        """Print the report. Raises ValueError for options and files that make no sense."""
        if self.html is not None:
            if not self.html.parent.is_dir():
                fail(f"--html {self.html}", "its folder does not exist", "Make it, or give another")
            if self.html.is_dir():
                fail(f"--html {self.html}", "is a folder", "Name a file in it")
            if self.html.exists() and self.html.suffix != ".html":
                fail(f"--html {self.html}", "exists and is no .html file", "Name another one")
        config = configs.load(self.config, given_options(self, "horizon", "terminal"), "info")
        report = offline_report(
            config.build_controlled(),
            steps=self.steps,
            loops=self.loops,
            seconds=self.seconds,
            progress=True,
            **config.references(),
        )
        print(f"{config.name}\n\n{report}")
        if self.html is not None:
            parts = [*_pictures(report), page.text("Offline report", str(report))]
            parts.append(page.table("Configuration", config.to_dict("info")))
            self.html.write_text(page.html_page(config.name, parts), encoding="utf-8")
        return Outcome(summary={"name": config.name, **record(report)})


def record(report: OfflineReport) -> dict[str, Any]:
    """Return a report as JSON data, under the names that its parts have in Python; None for a part
    that was not done, with the reason in notes."""
    low, high = report.volume
    found: dict[str, Any] = {
        "variables": report.variables,
        "rows": report.rows,
        "condition": report.condition,
        "volume": {"inner": low, "outer": high},
        "feasible_set": None,
        "recursion": None,
        "penalty": None,
        "terminal": None,
        "loops": None,
    }
    entries = lambda part, *names: {name: getattr(part, name) for name in names}
    found["set_point"] = entries(report.set_point, "x", "u", "drift", "broken")
    if report.feasible_set is not None:
        found["feasible_set"] = {"counts": report.feasible_set.counts()}
    if report.recursion is not None:
        claims = report.recursion.claims.items()
        found["recursion"] = {
            "claims": {name: dataclasses.asdict(claim) for name, claim in claims},
            "counts": report.recursion.loops.counts(),
            **entries(report.recursion, "volume", "lost_by_any", "lost_by_law"),
        }
    if report.penalty is not None:
        names = "rho_bar at label method exact advised sufficient".split()
        found["penalty"] = entries(report.penalty, *names)
    if report.terminal is not None:
        names = "recursive_feasibility stability factor".split()
        checks = [dataclasses.asdict(check) for check in report.terminal.checks]
        found["terminal"] = {**entries(report.terminal, *names), "checks": checks}
    if report.loops is not None:
        names = "steps feasible violation slack increase worst_x0 left".split()
        found["loops"] = {"starts": len(report.loops.x0s), **entries(report.loops, *names)}
    found["notes"] = {name: why for name, why in report.notes.items() if found[name] is None}
    return as_json(found)


def _pictures(report: OfflineReport) -> list[str]:
    """The feasible set, where there is one of two states."""
    fmap = report.feasible_set
    if fmap is None or fmap.x0s.shape[1] != 2:
        return []
    from jaxmpc.app.plots.maps import plot_feasible_set
    from jaxmpc.app.plots.style import save

    file = io.BytesIO()
    save(plot_feasible_set(fmap).figure, file)
    return [page.picture("feasible set", file.getvalue())]
