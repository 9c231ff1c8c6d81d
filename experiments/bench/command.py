"""How fast is jaxmpc on this machine, beside other solvers: `python experiments/bench`."""

import dataclasses
import itertools
import os
import platform
import shlex
import sys
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, cast

import jax
import tyro
from bench.cases import OURS, Case, Row, What, measure
from bench.families import FAMILIES, problem
from bench.growth import Growth, Point, exponents
from bench.plots import plot_bench, plot_growth
from bench.rivals import RIVALS
from bench.roofline import Ceilings
from matplotlib.figure import Figure

from jaxmpc.batches import workers
from jaxmpc.checks import available_memory, fail, in_units, nearest
from jaxmpc.files import remove_files, versions, write_json

PROG = "python experiments/bench"
KINDS = ("labels", "plans", "gradients", "loops", "none")
# What is measured where no option says otherwise.
USUAL: dict[str, Any] = {
    "what": ("labels", "plans", "gradients"),
    "families": ("joint", "springs4", "springs8", "turbompc"),
    "batches": (1, 1024, 16384),
    "tolerances": (1e-3, 1e-6),
    "loop": 300,
    "rounds": 3,
}
QUICK: dict[str, Any] = USUAL | {
    "what": ("labels", "plans"),
    "families": ("joint",),
    "batches": (256,),
    "tolerances": (1e-6,),
    "loop": 100,
}
MOST_BATCH = 2**20
FILES = ("bench.json", "bench.png", "growth.png")


def option(metavar: str, default: str) -> Any:
    """Return the tyro annotation that sets how an option and its default appear in the help."""
    return tyro.conf.arg(metavar=metavar, help_behavior_hint=f"(default: {default})")


Switch = Annotated[bool, tyro.conf.FlagCreatePairsOff, tyro.conf.arg(help_behavior_hint="")]


@dataclasses.dataclass(frozen=True)
class Bench:
    """How fast is jaxmpc on this machine, beside every other solver that is installed?

    What it does
      Solves the same problems with jaxmpc and with each rival that can be imported (pip install
      -e '.[bench]' in the folder of the source), all in this run, in turns, and judges every
      answer itself: primal residual, dual residual and duality gap are recomputed in float64 from
      each (z, y). No solver's own word counts. What is measured, by --what:
        labels     each state of a box proved feasible or infeasible (map_feasible_set); "with all
                   proofs" counts every plan and half-space, which else are made when used;
                   rivals look for the point of least norm that keeps the limits
        plans      the optimal plan from each of many feasible states: solve_many ("jaxmpc") and,
                   from device memory to device memory, jax.vmap(controller.plan) ("jaxmpc vmap";
                   on other devices than CPUs this alone)
        gradients  a loss of all plans and its gradient with respect to the diagonals of Q and R,
                   checked against central differences
        loops      TurboMPC's protocol, 50 samples of closed loop from each state, with gradient;
                   jaxmpc alone
        --growth   time and memory against batch, horizon N and number of states n, with exponents

    How to start
      $ python experiments/bench --quick          # about a minute on two cores
      $ python experiments/bench --what plans --families joint springs4 --batches 1024 16384
      $ python experiments/bench --what loops --families turbompc --batches 64 1024
      $ python experiments/bench --growth --what none
      Without options: some twenty minutes on two cores.

    How to read the output
      µs each      Best warm call, in microseconds a state. A ~ marks a solver that has no batch of
                   its own and ran, one after the other, over --loop of the states; its time for
                   the whole batch is an extrapolation. (Solvers in JAX run over a tenth of these
                   on a CPU.) Rivals are set up once and then updated, on one core each but Moreau.
      best/this    Time of the best rival over this one: above 1 it is faster. The best rival is
                   the fastest that solves 99 % of its states.
      solved       Share of the answers whose three residuals are within the tolerance.
      false        Answers whose status says otherwise than these residuals, or than a proof.
      cold         Seconds until the first answer, set-up and compiling included.
      compile      XLA's part of these; 0 where an earlier table has compiled the same program.
      ceiling      Time that the matrix products, or their bytes, take at the speed that this
                   machine has reached so far (measured before each table, on a busy machine too
                   low), over the time taken. The operations are a lower bound: loops whose length
                   is not known count once, and what is no matrix product not at all.
      bench.json   All rows with versions, machine, date and command; written after each call.
      bench.png    Microseconds a state against the batch; growth.png beside it with --growth.
      Ctrl-C       Stops; what was measured is kept and drawn.
      Machines are noisy: read the ratios of one run, not its microseconds.
      Exit code    0 done, for any outcome; 2 error (one line on stderr says which);
                   130 stopped by Ctrl-C.
    """

    what: Annotated[tuple[str, ...] | None, option("WHAT [WHAT ...]", "labels plans gradients")] = (
        None
    )
    """What to measure: labels, plans, gradients, loops; or none."""
    families: Annotated[
        tuple[str, ...] | None, option("NAME [NAME ...]", "joint springs4 springs8 turbompc")
    ] = None
    """Problems: joint, springs4, springs8, springs16, springs8_30 and springs16_30 (N = 30),
    quadrotor, cartpole, turbompc and turbompc_10."""
    batches: Annotated[tuple[int, ...] | None, option("B [B ...]", "1 1024 16384")] = None
    """Numbers of states, up to 1048576."""
    horizons: Annotated[tuple[int, ...] | None, option("N [N ...]", "the family's own")] = None
    """Prediction horizons."""
    tolerances: Annotated[tuple[float, ...] | None, option("EPS [EPS ...]", "1e-3 1e-6")] = None
    """Residuals that plans must reach; gradients and loops: the least of them; labels: 1e-6."""
    rivals: Annotated[tuple[str, ...] | None, option("NAME [NAME ...]", "all installed")] = None
    """Other solvers: daqp, moreau, piqp, osqp, clarabel, proxqp, qpax, jaxopt; or none."""
    loop: Annotated[int | None, option("B", "300")] = None
    """States that a solver without a batch of its own runs over."""
    rounds: Annotated[int | None, option("K", "3")] = None
    """Warm calls of each solver, of which the best counts."""
    seed: Annotated[int, option("K", "0")] = 0
    """Seed of the states."""
    growth: Switch = False
    """Also measure growth: batch 2^8 to 2^22 and N 10 to 320 (first family), n 2 to 64."""
    quick: Switch = False
    """The joint alone, labels and plans to 1e-6 of 256 states; other options win over it."""
    output: Annotated[Path, option("DIR", "jaxmpc-bench")] = Path("jaxmpc-bench")
    """Folder for the files; made where absent. Files of an earlier run there are replaced."""

    def settled(self) -> "Bench":
        """Return the command with values for the options that are not given."""
        usual = QUICK if self.quick else USUAL
        missing = {key: value for key, value in usual.items() if getattr(self, key) is None}
        return dataclasses.replace(self, **missing)

    def check(self) -> None:
        """Raise ValueError for options that make no sense."""
        for name, known in (
            ("what", KINDS),
            ("families", tuple(FAMILIES)),
            ("rivals", (*RIVALS, "none")),
        ):
            for value in getattr(self, name) or ():
                if value not in known:
                    there = f"There are {', '.join(known)}"
                    fail(f"--{name}", f"no {value!r}", f"{nearest(value, known)}{there}")
        for name in ("what", "families", "batches", "horizons", "tolerances", "rivals"):
            if getattr(self, name) == ():
                fail(f"--{name}", "no value", "Give one or more")
        for name in ("what", "rivals"):
            if "none" in (getattr(self, name) or ()) and len(getattr(self, name)) > 1:
                fail(f"--{name}", "none beside others", "Give none alone")
        for name, least, most in (
            ("batches", 1, MOST_BATCH),
            ("horizons", 1, 10_000),
            ("loop", 1, MOST_BATCH),
            ("rounds", 1, 10_000),
            ("seed", 0, 2**31 - 1),
        ):
            given = getattr(self, name)
            for value in given if isinstance(given, tuple) else [given] * (given is not None):
                if not least <= value <= most:
                    fail(f"--{name}", f"{value}", f"Give whole numbers from {least} to {most}")
        for value in self.tolerances or ():
            if not 1e-12 <= value < 1:
                fail("--tolerances", f"{value}", "Give numbers from 1e-12 to below 1")
        if self.what == ("none",) and not self.growth:
            fail("--what", "none without --growth", "Name what to measure")
        if self.what == ("none",) and self.horizons is not None:
            fail("--horizons", "given beside --what none", "Growth takes horizons of its own")

    def chosen(self) -> tuple[str, ...]:
        """Return the rivals that are asked for, installed or not."""
        given = tuple(RIVALS) if self.rivals is None else self.rivals
        return () if given == ("none",) else given

    def cases(self) -> Iterator[Case]:
        """Yield what is to be compared."""
        least = (min(self.tolerances or (1e-6,)),)
        tolerances = {"labels": (1e-6,), "plans": self.tolerances}
        for what in self.what or ():
            if what == "none":
                continue
            for family, horizon, batch, tolerance in itertools.product(
                self.families or (),
                self.horizons or (None,),
                self.batches or (),
                tolerances.get(what) or least,
            ):
                yield Case(
                    cast(What, what),
                    family,
                    batch,
                    tolerance,
                    horizon,
                    solvers=(*OURS, *self.chosen()),
                    loop=self.loop or 1,
                    rounds=self.rounds or 1,
                    seed=self.seed,
                )


class Record:
    """A run of the command: its rows so far, printed case by case and written after each call."""

    def __init__(self, command: Bench) -> None:
        self.command = command
        self.rows: list[Row] = []
        self.points: list[Point] = []
        self.notes: list[str] = []
        self.ceilings: Ceilings | None = None
        self.complete = False
        chosen = command.chosen()
        self.skipped = [name for name in chosen if not RIVALS[name].installed]
        found = {name: RIVALS[name].version for name in chosen if RIVALS[name].installed}
        self.versions, self.rivals = {"python": platform.python_version(), **versions()}, found
        self.machine = machine()
        self.date = datetime.now(UTC).isoformat(timespec="seconds")

    def run(self) -> int:
        """Measure all of it and return the exit code."""
        try:
            with jax.enable_x64(True):
                self.ceilings = Ceilings.measure()
                self.print_head()
                self.compare()
                if self.command.growth:
                    self.grow()
            self.complete = True
        except KeyboardInterrupt:
            print("\nstopped; what was measured is kept")
        remove_files(self.command.output, *FILES)
        self.write()
        files = ["bench.json", *self.draw()]
        print("  files ", *(self.command.output / name for name in files))
        return 0 if self.complete else 130

    def compare(self) -> None:
        """Measure the cases, print a table of each."""
        for case in self.command.cases():
            if case.what == "labels" and problem(case.family).states is None:
                self.note(f"labels of {case.family} left out: no state limits, all are feasible")
                continue
            before = self.rows
            found: list[Row] = []
            print(f"... {case.what} of {case.family}, {case.batch:,} states", file=sys.stderr)
            if self.ceilings:
                self.ceilings = self.ceilings.or_better(Ceilings.measure(1))
            try:
                for found in measure(case, self.ceilings, self.note):
                    self.rows = [*before, *found]
                    self.write()
            finally:
                print_case(found)

    def grow(self) -> None:
        """Measure growth and print its table."""
        print("growth of jax.vmap(controller.plan)")
        print(
            f"  {'':6}{'family':>12}{'batch':>10}{'N':>6}{'n':>5}{'variables':>11}"
            f"{'seconds':>10}{'µs each':>10}{'memory':>11}{'solved':>9}"
        )
        family = (self.command.families or ("joint",))[0]
        for point in Growth(family, seed=self.command.seed).run():
            self.points.append(point)
            self.write()
            size = f"{point.batch:>10,}{point.horizon:>6}{point.states:>5}{point.variables:>11}"
            print(f"  {point.axis:6}{point.family:>12}{size}", end="")
            memory = f"{in_units(point.memory):>11}"
            if point.seconds is None:
                print(f"{'':20}{memory}  {point.note}", flush=True)
                continue
            each = point.seconds / point.batch * 1e6
            print(f"{point.seconds:>10.4f}{each:>10.2f}{memory}{point.solved:>9.2%}", flush=True)
        for axis, found in exponents(self.points).items():
            powers = ", ".join(f"{name} ~ {axis}^{power:.2f}" for name, power in found.items())
            print(f"  upper half of the points: {powers}")
        print()

    def note(self, line: str) -> None:
        """Keep and print what is left out, once."""
        if line not in self.notes:
            self.notes.append(line)
            print(line, flush=True)

    def document(self) -> dict[str, Any]:
        """Return all that is known so far as JSON data."""
        return {
            "command": shlex.join([*PROG.split(), *sys.argv[1:]]),
            "date": self.date,
            "complete": self.complete,
            "settings": {
                key: str(value) if isinstance(value, Path) else value
                for key, value in dataclasses.asdict(self.command).items()
            },
            "versions": {**self.versions, **self.rivals},
            "machine": self.machine,
            "ceilings": dataclasses.asdict(self.ceilings) if self.ceilings else None,
            "skipped": self.skipped,
            "notes": self.notes,
            "rows": [row.plain() for row in self.rows],
            "growth": [point.plain() for point in self.points],
            "exponents": exponents(self.points),
        }

    def write(self) -> None:
        """Write bench.json."""
        write_json(self.command.output / "bench.json", self.document())

    def draw(self) -> list[str]:
        """Write the plots of what there is and return their names."""
        figures: dict[str, Figure] = {}
        if self.rows:
            figures["bench.png"] = plot_bench(self.rows)
        if self.points:
            figures["growth.png"] = plot_growth(self.points)
        for name, figure in figures.items():
            path = self.command.output / name
            figure.savefig(path, dpi=150, bbox_inches="tight", pad_inches=0.15)
        return list(figures)

    def print_head(self) -> None:
        """Print machine, versions and ceilings."""
        m, c = self.machine, self.ceilings
        assert c is not None
        devices = f"{m['devices']} x {m['device']}"
        operations = f"{c.gflops32:,.0f} GFLOP/s float32, {c.gflops64:,.0f} float64"
        rows = [
            ("machine", f"{m['cpu']}, {m['cores']} cores, {in_units(m['memory'])}"),
            ("device", devices if m["backend"] != "cpu" else "the CPU"),
            ("jaxmpc", ", ".join(f"{k} {self.versions[k]}" for k in ("python", "jax", "numpy"))),
            ("rivals", ", ".join(f"{k} {v}" for k, v in self.rivals.items()) or "none"),
            ("ceilings", f"{operations}, {c.gigabytes:,.1f} GB/s"),
        ]
        if self.skipped:
            rows.append(("skipped", f"not installed: {', '.join(self.skipped)}"))
        for name, value in rows:
            print(f"  {name:<9} {value}")
        print(flush=True)


def machine() -> dict[str, Any]:
    """Return what the machine is: processor, cores this process may use, memory, devices."""
    try:
        lines = Path("/proc/cpuinfo").read_text().splitlines()
        cpu = next(
            line.partition(":")[2].strip() for line in lines if line.startswith("model name")
        )
    except (OSError, StopIteration):
        cpu = platform.processor() or platform.machine()
    devices = jax.devices()
    cores = workers() if devices[0].platform == "cpu" else os.cpu_count()
    return {
        "cpu": cpu,
        "cores": cores,
        "memory": available_memory(),
        "backend": devices[0].platform,
        "device": devices[0].device_kind,
        "devices": len(devices),
        "system": platform.platform(),
        "environment": {
            name: os.environ[name]
            for name in ("XLA_FLAGS", "OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "JAX_PLATFORMS")
            if name in os.environ
        },
    }


def print_case(rows: list[Row]) -> None:
    """Print the table of one case."""
    if not rows:
        return
    r = rows[0]
    size = f"{r.batch:,} states, {r.variables} variables, {r.rows} rows"
    print(f"{r.what}: {r.family}, N = {r.horizon}, {size}, to {r.tolerance:g}")
    print(
        f"  {'':13}{'µs each':>12} {'best/this':>10}{'solved':>9}{'false':>7}{'cold s':>9}"
        f"{'compile s':>11}  ceiling"
    )
    for r in sorted(rows, key=lambda r: r.microseconds):
        mark = "~" if r.extrapolated else ""
        speedup = "" if r.speedup is None else f"{r.speedup:.2f}"
        solved = "" if r.solved is None else f"{r.solved:.2%}"
        false = "" if r.false is None else f"{r.false}"
        more = "" if r.ceiling is None else f"{r.ceiling:.1%} of {r.bound}"
        if r.forward_microseconds is not None:
            more += f"  forward {r.forward_microseconds:.2f} µs"
        if r.gradient_error is not None:
            more += f", error {r.gradient_error:.1e}"
        if r.proofs_microseconds is not None:
            more += f"  with all proofs {r.proofs_microseconds:.2f} µs"
        each = f"{mark}{r.microseconds:.2f}"
        seconds = f"{r.cold_seconds:>9.2f}{r.compile_seconds:>11.2f}"
        found = f"{each:>12} {speedup:>10}{solved:>9}{false:>7}"
        print(f"  {r.solver:13}{found}{seconds}  {more.strip(', ')}")
    some = sorted({r.states for r in rows if r.extrapolated})
    if some:
        print(f"  ~ over {' or '.join(map(str, some))} of the states, extrapolated")
    print(flush=True)


def main(argv: Sequence[str] | None = None) -> int:
    """Measure, print the tables, write the files; return the exit code."""
    words = sys.argv[1:] if argv is None else argv
    try:
        command = tyro.cli(Bench, prog=PROG, args=words).settled()
        command.check()
        command.output.mkdir(parents=True, exist_ok=True)
        record = Record(command)
    except SystemExit as stop:
        return int(stop.code or 0)
    except (ValueError, OSError) as error:
        where = f"--output: {error.strerror}" if isinstance(error, OSError) else str(error)
        print(f"{PROG}: error: {where}", file=sys.stderr)
        return 2
    return record.run()
