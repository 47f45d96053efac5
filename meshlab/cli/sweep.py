"""`meshctl lab sweep`: many seeds and settings of one mission in virtual time, compared with confidence intervals.

`mesh_sweep` does the work; here is what one case is: the texts of the mission and its ground, with the settings ->
`mission_trial.run_trial` -> figures. No fleet has to run.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from meshctl.cli.context import AsJson
from meshctl.diagnostics import Diagnostic, InvalidInput
from meshctl.errors import InputError
from meshctl.placement.ground import GROUND_KEYS
from meshlab import scenario_file

if TYPE_CHECKING:
    from mesh_sweep.cases import Case, Settings
    from mesh_sweep.command import Study
    from meshlab.scenario import Scenario

SHOWN = ("arrived", "longest_gap_s", "robots.*.arrived", "robots.*.farthest_m")
SHORT = {"exponent": "air.exponent", "power": "air.tx_power_dbm"}
_NAMED = frozenset({"robots", "beacons", "nodes"})
_GROUND = frozenset({*GROUND_KEYS, "links"})
# the code that computes a result
_OURS = ("mission_trial.py", "propagation.py", "propagation_file.py", "scenario.py", "scenario_file.py", "spec.py")
_FLEETS = ("placement/ground.py", "placement/path_loss.py")


def register(app: typer.Typer) -> None:
    """Add the command to `app`."""
    app.command("sweep")(sweep)


def sweep(
    file: Annotated[Path | None, typer.Argument(help="The mission (YAML), as for `meshctl lab mission`.")] = None,
    seeds: Annotated[str, typer.Option("--seeds", metavar="N", help="Number of seeds, or a range: 501-1000.")] = "20",
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="PATH=VALUE,...",
            help="Values of an entry, such as air.exponent=3,4 or beacons.b02.drop_s=80,99; several options give "
            "every combination.",
        ),
    ] = None,
    out: Annotated[Path | None, typer.Option("--out", help="Results; default: MISSION-sweep.jsonl.")] = None,
    jobs: Annotated[int, typer.Option("--jobs", min=0, max=1024, help="Processes; 0: one for each core.")] = 0,
    dask: Annotated[
        str,
        typer.Option(
            "--dask",
            metavar="ADDRESS",
            help="Run on a Dask cluster: its address, such as tcp://host:8786, or the JSON file of its scheduler.",
        ),
    ] = "",
    executor: Annotated[
        str, typer.Option("--executor", metavar="MODULE:NAME", help="Run on another concurrent.futures.Executor.")
    ] = "",
    figures: Annotated[
        list[str] | None, typer.Option("--figure", metavar="PATTERN", help="Figures to compare: 'robots.*.hops'.")
    ] = None,
    goals: Annotated[
        list[str] | None,
        typer.Option("--goal", metavar="FIGURE<=N", help="Also show the share of runs that meet this."),
    ] = None,
    report: Annotated[Path | None, typer.Option("--report", help="Write the comparison as an HTML page.")] = None,
    show: Annotated[Path | None, typer.Option("--show", help="Only compare the results of this file.")] = None,
    as_json: AsJson = False,
) -> None:
    """Compare propagation, placement and intervals of a mission over many seeds, in virtual time.

    Each robot reports to the base; seeds decide the slow fading of each place and the frames that are lost. Results are
    appended to a file; the same command continues an interrupted sweep.

    Exit code: 0 every case has a result, 1 some have none, 2 could not run.

    Example: meshctl lab sweep mission.yaml --seeds 200 --set beacons.b02.drop_s=80,99,120

    Example: meshctl lab sweep mission.yaml --set air.exponent=3.5,4.4 --set trial.route_s=1,5 --report mission.html
    """
    # here, so that other commands start without it
    from mesh_sweep import command
    from mesh_sweep.errors import SweepError

    options = command.SweepOptions(
        seeds=seeds,
        set=settings or (),
        out=out,
        jobs=jobs,
        dask=dask,
        executor=executor,
        figures=figures or (),
        goals=goals or (),
        report=report,
        as_json=as_json,
    )
    try:
        if show is not None:
            code = command.show(show, options, SHOWN)
        elif file is None:
            raise InputError("expected a mission, found none", hint="see `meshctl lab sweep --help`")
        else:
            code = command.sweep(study_of(file), options, SHORT)
    except SweepError as error:
        raise InputError(str(error)) from error
    except OSError as error:
        raise InputError(f"{error.filename}: {error.strerror}" if error.filename else str(error)) from error
    raise typer.Exit(code)


def study_of(file: Path) -> Study:
    """Raises InvalidInput for an invalid mission."""
    from mesh_sweep.command import Study
    from mesh_sweep.results import Identity
    from mesh_sweep.scenario_text import fingerprint

    scenario = scenario_file.load(file)
    text = file.read_text(encoding="utf-8")
    place = scenario_file.ground_path(text, file)
    ground = None if place is None else place.read_text(encoding="utf-8")
    texts = [text] if ground is None else [text, ground]
    identity = Identity(scenario.name, fingerprint(texts, frozenset()), revision())
    return Study(
        identity,
        partial(run_case, text, ground, str(file), identity.revision),
        partial(_check, text, ground, str(file)),
        SHOWN,
        (file,) if place is None else (file, place),
    )


def revision() -> str:
    """Of the code that simulates: the lab's and the propagation models of meshctl."""
    import meshctl
    from mesh_sweep.revision import source_revision

    fleets = source_revision(Path(str(meshctl.__file__)).parent, _FLEETS)
    return f"{fleets}-{source_revision(Path(__file__).parents[1], _OURS).rpartition('-')[2]}"


def run_case(text: str, ground: str | None, file: str, expected_revision: str, case: Case) -> dict[str, float | None]:
    """One mission on a worker, which may be another machine: it gets the files' texts."""
    from mesh_sweep.revision import check_worker
    from meshlab.mission_trial import run_trial

    check_worker(expected_revision, revision())
    return run_trial(_parse(text, ground, file, case.settings), case.seed)


def _check(text: str, ground: str | None, file: str, settings: Settings) -> None:
    _parse(text, ground, file, settings)


def _parse(text: str, ground: str | None, file: str, settings: Settings) -> Scenario:
    """The mission with the settings, each in the file that has its section. Raises SweepError."""
    from mesh_sweep.errors import SweepError
    from mesh_sweep.scenario_text import EditedText, compose, steps_of, with_settings

    place = scenario_file.ground_path(text, Path(file))
    own = {str(key.value) for key, _ in getattr(compose(text), "value", ())}

    def is_of_ground(path: str) -> bool:
        top = steps_of(path)[:1]
        return ground is not None and bool(top) and top[0] in _GROUND and top[0] not in own

    mission = with_settings(text, tuple(setting for setting in settings if not is_of_ground(setting[0])), file, _NAMED)
    terrain: EditedText | None = None
    if ground is not None:
        terrain = with_settings(
            ground, tuple(setting for setting in settings if is_of_ground(setting[0])), str(place), _NAMED
        )
    try:
        return scenario_file.parse(mission.text, Path(file), None if terrain is None else terrain.text)
    except InvalidInput as error:
        words = " ".join(f"--set {path}={value}" for path, value in settings)
        lines = {file: mission.original_line, str(place): terrain.original_line if terrain else mission.original_line}
        raise SweepError(
            "\n".join(f"{_problem(diagnostic, lines)} ({words})" for diagnostic in error.diagnostics)
        ) from None


def _problem(diagnostic: Diagnostic, lines: Mapping[str, Callable[[int], int]]) -> str:
    place = diagnostic.position
    line = lines[place.file](place.line) if place.file in lines else place.line
    return f"{place.file}:{line}: {diagnostic.text}"
