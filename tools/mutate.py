"""Does the accuracy gate see a changed stage? Scale its tuned constants in a copy of the package and run the gate.

Usage: python tools/mutate.py [--stage NAME] [--factor F] [--only CONSTANT] [--jobs N] [--all-clips] [--list]

Without arguments: eight runs, all tuned constants of one stage times 0.7, then times 1.4, stage by stage. A run passes
when the gate turns red, or when no pose changes by a bit: then the constants do not matter to any clip. The exit status
is 0 when at least 80 % of the runs pass. The checkout is never written to.
"""

from __future__ import annotations

import argparse
import ast
import dataclasses
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from xml.etree import ElementTree

import numpy as np
import yaml

ROOT = Path(__file__).resolve().parents[1]
GATE = ROOT / "test" / "accuracy" / "test_default_preset.py"
FACTORS = (0.7, 1.4)
NEEDED_SHARE = 0.8

Number = int | float
Value = Number | tuple["Value", ...]


@dataclasses.dataclass(frozen=True)
class Stage:
    """Where the tuned constants of a stage are.

    Attributes:
        files: patterns below ``hat_ros/``.
        without: names of files among them that the default preset does not run.
        options: prefixes of configuration keys.
        without_options: prefixes among them that it does not use.
        in_banks: whether the banks of views depend on them, which are kept in the cache folder under other keys.
    """

    files: tuple[str, ...]
    without: tuple[str, ...] = ()
    options: tuple[str, ...] = ()
    without_options: tuple[str, ...] = ()
    in_banks: bool = False


STAGES = {
    "segmentation": Stage(
        ("segmentation/*.py",),
        ("annotated.py", "mask2former.py"),
        ("segmentation.",),
        ("segmentation.mask2former.",),
    ),
    "hypotheses": Stage(
        ("hypotheses/*.py", "target/view_bank.py", "target/polar.py"),
        ("megapose.py", "gigapose.py", "picopose.py", "picopose_templates.py"),
        ("hypotheses.", "keyframes."),
        ("hypotheses.megapose.", "hypotheses.picopose."),
        in_banks=True,
    ),
    "motion": Stage(
        ("motion/*.py",),
        ("droid.py", "droid_frontend.py", "droid_keyframes.py", "droid_graph.py", "droid_global.py"),
        ("slam.",),
        ("slam.droid.",),
    ),
    "refinement and tracking": Stage(
        ("refinement/*.py", "tracking/*.py"),
        options=("refinement.", "fusion.", "prior."),
        in_banks=True,
    ),
}

# What is no tuned constant, by name. The rest of a stage's module-level numbers and tuples of numbers are.
NOT_TUNED = (
    (r".*_?FORMAT$", "version of a file in the cache"),
    (r".*BYTES$", "size of memory"),
    (r"(MASK|EDGE|COL_\w+|_JUDGED|_CRITERIA)$", "index or flag"),
    (r"(N_PARAMETERS|N_RINGS|_RADII|_ANGLES|_DEPTH_BINS|\w*COLUMNS)$", "size of arrays"),
    (
        r"(_N_VIEWS|_VIEW_COUNTS|hypotheses\.template\.n_views|hypotheses\.template\.n_angles)$",
        "only some counts exist",
    ),
)


@dataclasses.dataclass(frozen=True)
class Constant:
    """A tuned constant.

    Attributes:
        name: as ``--only`` takes it: ``room/module.NAME``, or the key of an option.
        value: what it is.
        path: source file below ``hat_ros/``, None for an option.
        span: first and last byte of the value in that file.
        low: least value that an option accepts, None = any.
        high: the largest.
    """

    name: str
    value: Value
    path: str | None = None
    span: tuple[int, int] = (0, 0)
    low: float | None = None
    high: float | None = None

    def scaled(self, factor: float) -> Value:
        """The value times a factor, as far as it stays legal."""
        value = _scaled(self.value, factor, self.name)
        if isinstance(value, tuple):
            return value
        value = value if self.low is None else max(value, type(value)(self.low))
        return value if self.high is None else min(value, type(value)(self.high))


@dataclasses.dataclass(frozen=True)
class Verdict:
    """What a run of the gate said.

    Attributes:
        clips: clip -> bands that it left; "crash: ..." for one that did not end.
        poses: clip -> digest of its poses, of the clips that were run.
    """

    clips: dict[str, str]
    poses: dict[str, str]

    @property
    def crashed(self) -> bool:
        """Whether no clip was red for its accuracy."""
        return bool(self.clips) and all(text.startswith("crash") for text in self.clips.values())


def constants(stage: Stage) -> list[Constant]:
    """All tuned constants of a stage, in the checkout."""
    found: list[Constant] = []
    package = ROOT / "hat_ros"
    for pattern in stage.files:
        for path in sorted(package.glob(pattern)):
            if path.name not in stage.without:
                found += _in_source(path.read_bytes(), path.relative_to(package).as_posix())
    return [*found, *_in_configuration(stage)]


def _in_source(source: bytes, path: str) -> Iterator[Constant]:
    starts = np.cumsum([0] + [len(line) for line in source.splitlines(keepends=True)])
    for item in ast.parse(source).body:
        if isinstance(item, ast.Assign):
            target, node = item.targets[0], item.value
        elif isinstance(item, ast.AnnAssign) and item.value is not None:
            target, node = item.target, item.value
        else:
            continue
        names = [part.id for part in ast.walk(target) if isinstance(part, ast.Name)]
        value = _number(node)
        if value is None or not all(re.fullmatch(r"_?[A-Z][A-Z0-9_]*", name) for name in names):
            continue
        if why_not_tuned(names[0]) is None:
            begin = int(starts[node.lineno - 1]) + node.col_offset
            end = begin + len(ast.get_source_segment(source.decode(), node) or "")
            yield Constant(f"{path.removesuffix('.py')}.{','.join(names)}", value, path, (begin, end))


def _number(node: ast.expr) -> Value | None:
    """The value of an expression of numbers alone; None for any other expression."""
    if any(isinstance(part, ast.Name) and part.id != "np" for part in ast.walk(node)):
        return None
    return _plain(eval(compile(ast.Expression(node), "constant", "eval"), {"np": np}))


def _plain(value: object) -> Value | None:
    if isinstance(value, tuple):
        items = [_plain(item) for item in value]
        return None if not items or None in items else tuple(item for item in items if item is not None)
    if isinstance(value, int | float) and not isinstance(value, bool):
        return int(value) if isinstance(value, int) else float(value)
    return None


def _in_configuration(stage: Stage) -> Iterator[Constant]:
    from hat_ros.config import flat_options, load_config

    for name, (value, option) in flat_options(load_config("default")).items():
        if not name.startswith(stage.options) or (stage.without_options and name.startswith(stage.without_options)):
            continue
        number = _plain(value)
        if number is not None and option.metadata["level"] == "expert" and why_not_tuned(name) is None:
            yield Constant(name, number, low=option.metadata.get("low"), high=option.metadata.get("high"))


def why_not_tuned(name: str) -> str | None:
    """The rule that leaves a constant out, None if none does."""
    return next((reason for pattern, reason in NOT_TUNED if re.match(pattern, name)), None)


def _scaled(value: Value, factor: float, name: str) -> Value:
    if isinstance(value, tuple):
        return tuple(_scaled(item, factor, name) for item in value)
    if "PERCENT" in name:
        return min(100.0, value * factor)
    if isinstance(value, float) or value == 0:
        return value * factor
    if "PX" in name and value % 2:  # often the side of a window about a pixel, which must stay odd
        return max(1, 2 * round((value * factor - 1) / 2) + 1)
    return max(1, round(value * factor)) if value > 0 else min(-1, round(value * factor))


def mutated_copy(folder: Path, changed: Sequence[Constant], factor: float, like: Path = ROOT) -> Path:
    """A copy of a folder's package with scaled constants: the folder to put on PYTHONPATH.

    Of another copy, the compiled code comes along, but for the modules that import a changed one: constants are
    compiled in. The checkout's may be older than its constants.
    """
    package = folder / "hat_ros"
    shutil.copytree(like / "hat_ros", package, ignore=shutil.ignore_patterns("__pycache__") if like == ROOT else None)
    paths = {constant.path for constant in changed if constant.path is not None}
    for path in paths:
        source = (package / path).read_bytes()
        mine = [constant for constant in changed if constant.path == path]
        for constant in sorted(mine, key=lambda c: c.span, reverse=True):
            start, end = constant.span
            source = source[:start] + repr(constant.scaled(factor)).encode() + source[end:]
        (package / path).write_bytes(source)
    for path in _importing(package, paths):
        for compiled in (package / path).parent.glob(f"__pycache__/{Path(path).stem}.*"):
            compiled.unlink()
    _write_configuration(package / "config" / "presets" / "default.yaml", changed, factor)
    return folder


def _importing(package: Path, changed: set[str]) -> set[str]:
    """Source files that import one of some files, directly or through others, and those files themselves."""
    imports: dict[str, set[str]] = {}
    for path in package.rglob("*.py"):
        nodes = [node for node in ast.walk(ast.parse(path.read_bytes())) if isinstance(node, ast.ImportFrom)]
        modules = {node.module or "" for node in nodes}
        modules |= {f"{node.module}.{alias.name}" for node in nodes for alias in node.names}  # it may be a module
        files = {f"{module.removeprefix('hat_ros.').replace('.', '/')}.py" for module in modules}
        imports[path.relative_to(package).as_posix()] = files
    found = set(changed)
    while more := {path for path, files in imports.items() if files & found} - found:
        found |= more
    return found


def _write_configuration(preset: Path, changed: Sequence[Constant], factor: float) -> None:
    from hat_ros.config import config_from_dict, config_to_dict, load_config

    data = config_to_dict(load_config("default"))
    for constant in changed:
        if constant.path is None:
            *sections, key = constant.name.split(".")
            node = data
            for section in sections:
                node = node[section]
            node[key] = constant.scaled(factor)
    # What configuration rules out: priors that depend on a frame in flight.
    data["prior"]["delay_frames"] = max(data["prior"]["delay_frames"], data["graph"]["credits_replay"])
    config_from_dict(data)
    preset.write_text(yaml.safe_dump(data), encoding="utf-8")


def run_gate(folder: Path, clips: Path, cache: Path, all_clips: bool) -> Verdict:
    """Run the checkout's gate on the package in a folder."""
    report = folder / "report.xml"
    environment = {name: value for name, value in os.environ.items() if name != "NUMBA_CACHE_DIR"} | {
        "PYTHONPATH": str(folder),
        "XDG_CACHE_HOME": str(cache),
        "ACCURACY_CLIPS": str(clips),
    }
    command = [sys.executable, "-m", "pytest", str(GATE), "-c", str(ROOT / "pyproject.toml"), "--rootdir", str(ROOT)]
    command += ["-p", "no:cacheprovider", f"--junitxml={report}"]
    command += [] if all_clips else ["--maxfail=1"]
    done = subprocess.run(command, cwd=folder, env=environment, capture_output=True, text=True)
    if done.returncode not in (0, 1) or not report.is_file():  # pytest: all passed, some failed
        said = f"{done.stdout[-300:]}{done.stderr[-300:]}"
        return Verdict({"all": f"crash: pytest ended with {done.returncode}: {said}"}, {})
    return _read_report(report, folder)


def _read_report(report: Path, folder: Path) -> Verdict:
    clips, poses = {}, {}
    for case in ElementTree.parse(report).iter("testcase"):
        properties = {item.get("name", ""): item.get("value", "") for item in case.iter("property")}
        clip = properties.get("clip", case.get("name", ""))
        if Path(properties.get("package", folder / "hat_ros")) != folder / "hat_ros":
            raise RuntimeError(f"the gate ran on {properties['package']}, not on the copy in {folder}")
        if "poses" in properties:
            poses[clip] = properties["poses"]
        failures = [*case.iter("failure"), *case.iter("error")]
        if failures:
            message = (failures[0].get("message") or "").partition("\n")[0]
            clips[clip] = properties.get("left") or f"crash: {message[:100]}"
    return Verdict(clips, poses)


def main(arguments: Sequence[str] | None = None) -> int:
    """Run what was asked for and print the table; see the module's text."""
    options = _parse(arguments)
    runs = [
        (name, factor, [c for c in constants(stage) if not options.only or c.name == options.only])
        for name, stage in STAGES.items()
        for factor in options.factor
        if not options.stage or name in options.stage
    ]
    runs = [(name, factor, [c for c in found if c.scaled(factor) != c.value]) for name, factor, found in runs]
    runs = [run for run in runs if run[2]]
    if not runs:
        print("no constant to mutate: see --list", file=sys.stderr)
        return 2
    if options.list:
        for name, factor, changed in runs:
            for constant in changed:
                print(f"{name} x{factor}: {constant.name} {constant.value} -> {constant.scaled(factor)}")
        return 0
    with tempfile.TemporaryDirectory(prefix="mutate-") as work:
        return _run_all(runs, Path(work), options)


def _run_all(runs: list[tuple[str, float, list[Constant]]], work: Path, options: argparse.Namespace) -> int:
    clips = options.clips or work / "clips"
    caches = work / "cache"
    unchanged = run_gate(mutated_copy(work / "unchanged", (), 1.0), clips, caches / "unchanged", True)
    if unchanged.clips:
        print(f"the gate is red without any mutation: {unchanged.clips}", file=sys.stderr)
        return 2
    print(f"{'stage':24s} {'factor':>6s} {'constants':>9s}  verdict", flush=True)

    def run(number: int) -> bool:
        name, factor, changed = runs[number]
        folder = mutated_copy(work / f"run{number}", changed, factor, work / "unchanged")
        cache = caches / (f"run{number}" if STAGES[name].in_banks else "unchanged")
        verdict = run_gate(folder, clips, cache, options.all_clips)
        text, good = _judge(verdict, unchanged)
        print(f"{name:24s} {factor:6g} {len(changed):9d}  {text}", flush=True)
        shutil.rmtree(folder)
        return good

    with ThreadPoolExecutor(options.jobs) as pool:
        good = list(pool.map(run, range(len(runs))))
    print(f"{sum(good)} of {len(good)} runs turn the gate red or change no pose")
    return 0 if sum(good) >= NEEDED_SHARE * len(good) else 1


def _judge(verdict: Verdict, unchanged: Verdict) -> tuple[str, bool]:
    if verdict.clips:
        where = "; ".join(f"{clip}: {text}" for clip, text in verdict.clips.items())
        return f"red by {'crash' if verdict.crashed else 'accuracy'} ({where})", True
    if verdict.poses == unchanged.poses:
        return "no pose changed", True
    differing = sum(verdict.poses.get(clip) != poses for clip, poses in unchanged.poses.items())
    return f"GREEN, though the poses of {differing} clips changed", False


def _parse(arguments: Sequence[str] | None) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--stage", action="append", choices=list(STAGES), help="only this stage (may be repeated)")
    parser.add_argument("--factor", action="append", type=float, help=f"instead of {FACTORS} (may be repeated)")
    parser.add_argument("--only", metavar="CONSTANT", help="this constant alone, named as --list names it")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time")
    parser.add_argument("--all-clips", action="store_true", help="do not stop at the first red clip")
    parser.add_argument("--list", action="store_true", help="say what would be mutated")
    parser.add_argument("--clips", type=Path, help="folder to keep the rendered clips in from call to call")
    options = parser.parse_args(arguments)
    options.factor = options.factor or list(FACTORS)
    return options


if __name__ == "__main__":
    sys.exit(main())
