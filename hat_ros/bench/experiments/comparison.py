"""``hat bench``: clips x methods x masks x starts in one table, so that the failing stage shows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from glob import glob
from pathlib import Path
from typing import Any

import numpy as np

from hat_ros.bench.datasets.importer import detections_by_sequence, open_dataset
from hat_ros.bench.datasets.protocols import protocol_of
from hat_ros.bench.evaluation import metrics
from hat_ros.bench.evaluation.result_folder import read_errors
from hat_ros.bench.evaluation.tables import Column, Table
from hat_ros.bench.experiments.run_matrix import GRAPH, Job, Outcome
from hat_ros.bench.methods.modes import MODES
from hat_ros.bench.source import SourceSpec
from hat_ros.bench.synth.suite import SUITE, SUITE_SETTINGS
from hat_ros.errors import DatasetError, UsageError

# A recording, and ``key=value`` settings of its own.
Clip = tuple[SourceSpec, tuple[str, ...]]

GIVEN_MASKS = ("segmentation.backend=annotated",)

_WHERE = (
    Column("clip", "clip"),
    Column("masks", "masks"),
    Column("start", "start"),
    Column("mode", "mode"),
)
_FIGURES = (
    Column("E_p_mean", "E_p", ".4f", "$E_p$"),
    Column("E_p_sd", "SD", ".3f"),
    Column("E_t_m_mean", "E_t m", ".4f", r"$E_t$ (m)"),
    Column("E_t_m_sd", "SD", ".4f"),
    Column("E_q_deg_mean", "E_q deg", ".2f", r"$E_q$ ($^\circ$)"),
    Column("E_q_deg_sd", "SD", ".2f"),
    Column("E_q_over_90_share", ">90", ".1%"),
    Column("E_p_sym_mean", "E_p sym", ".4f", r"$E_p^{\mathrm{sym}}$"),
    Column("MSSD_m_mean", "MSSD m", ".4f"),
    Column("MSPD_px_mean", "MSPD px", ".2f"),
    Column("coverage", "cover", ".1%"),
    Column("oracle_within_15_share", "best<15", ".1%"),
    Column("oracle_within_30_share", "best<30", ".1%"),
    Column("mask_iou_mean", "IoU", ".3f"),
    Column("mask_iou_over_0_9_share", "IoU>.9", ".1%"),
    Column("relative_motion_deg_median", "rel deg", ".3f"),
    Column("untrue_tracking_share", "false TRACKING", ".1%"),
    Column("inside_95_share", "in 95%", ".1%"),
    Column("fps", "fps", ".1f"),
    Column("fps_without_detector", "fps w/o detector", ".1f"),
    Column("latency_ms_p50", "p50 ms", ".1f"),
    Column("latency_ms_p99", "p99 ms", ".1f"),
    Column("cpu_ms_mean", "cpu ms", ".1f"),
    Column("peak_memory_mib", "MiB", ".0f"),
    Column("memory_growth_mib", "+MiB", ".1f"),
)
_STAGES = (
    Column("fps", "fps", ".1f"),
    Column("cpu_ms_mean", "cpu ms", ".2f"),
    Column("decode_ms_mean", "decode ms", ".2f"),
    Column("segmentation_ms_mean", "segmentation ms", ".2f"),
    Column("hypotheses_ms_mean", "hypotheses ms", ".2f"),
    Column("motion_ms_mean", "motion ms", ".2f"),
    Column("selector_ms_mean", "selector ms", ".2f"),
    Column("fusion_ms_mean", "fusion ms", ".2f"),
)


@dataclass(frozen=True)
class Entry:
    """A method as the table lists it.

    Attributes:
        name: what the table calls it, and part of its run folders' names.
        mode: method, or ``graph``.
        config: preset or YAML file.
        settings: on top of it, ``key=value``.
    """

    name: str
    mode: str
    config: str
    settings: tuple[str, ...] = ()

    @classmethod
    def parse(cls, text: str, default_config: str) -> Entry:
        """Read ``NAME=MODE[:CONFIG][,KEY=VALUE ...]``.

        Raises:
            UsageError: malformed, an unknown mode, or a name that cannot be part of a folder's.
        """
        name, separator, rest = text.partition("=")
        how, *settings = rest.split(",")
        mode, _, config = how.partition(":")
        if not separator or not name or "/" in name or any("=" not in setting for setting in settings):
            raise UsageError(f"--method {text}: expected NAME=MODE[:CONFIG][,KEY=VALUE ...]")
        if mode not in (*MODES, GRAPH):
            raise UsageError(f"--method {text}: mode '{mode}' is unknown, choose one of {', '.join((*MODES, GRAPH))}")
        return cls(name, mode, config or default_config, tuple(settings))


def clips_named(texts: Sequence[str]) -> list[Clip]:
    """Recordings, perhaps with settings of their own: ``CLIP`` or ``CLIP@key=value[,key=value]``; CLIP may hold ``*``.

    Raises:
        UsageError: there is no such file or folder.
    """
    clips: list[Clip] = []
    for text in texts:
        pattern = text
        settings: tuple[str, ...] = ()
        if not Path(text).exists() and "@" in text:
            pattern, _, rest = text.rpartition("@")
            settings = tuple(rest.split(","))
        found = [pattern] if Path(pattern).exists() else sorted(glob(pattern))
        if not found:
            raise UsageError(f"recording {pattern}: no such file or folder")
        clips += [(SourceSpec(Path(path).resolve()), settings) for path in found]
    return clips


def clips_of_suite(root: Path) -> list[Clip]:
    """The bags that ``hat synth suite`` wrote, with the settings that belong to their group.

    Raises:
        UsageError: there is none.
    """
    clips = [
        (SourceSpec((root / group / name).resolve()), SUITE_SETTINGS.get(group, ()))
        for group, names in SUITE.items()
        for name in names
        if (root / group / name).exists()
    ]
    if not clips:
        raise UsageError(f"--suite {root}: no clip of the suite is there; `hat synth suite --out {root}` renders it")
    return clips


def clips_of_dataset(
    dataset: str,
    root: Path,
    model: Path | None,
    sequences: Sequence[str],
    detections: Path | None = None,
    published: bool = False,
) -> list[Clip]:
    """The sequences of a data set as published, without writing bags; each with its detections, if any are given.

    ``published``: by the published protocol, and of its split alone unless sequences are named.

    Raises:
        UsageError, DatasetError: see :func:`hat_ros.bench.datasets.importer.open_dataset`.
    """
    root, model = root.resolve(), model and model.resolve()
    split = protocol_of(dataset).sequences if published and not sequences else sequences
    try:
        recordings = list(open_dataset(dataset, root, model, split))
    except DatasetError as error:
        if split and not sequences and "no sequence named" in str(error):
            raise DatasetError(
                f"{root}: nothing of the published split is there ({split[0]} to {split[-1]}); name what is with "
                f"--sequence, or take everything with --protocol none"
            ) from None
        raise
    found = {} if detections is None else detections_by_sequence(detections.resolve(), recordings)
    names = [recording.name for recording in recordings]
    return [(SourceSpec(root, dataset, name, model, found.get(name), published=published), ()) for name in names]


def bench_jobs(
    clips: Sequence[Clip],
    modes: Sequence[str],
    masks: Sequence[str],
    starts: Sequence[int],
    config: str,
    overrides: Sequence[str] = (),
    limit: int | None = None,
    externals: Mapping[str, str] | None = None,
    methods: Sequence[Entry] = (),
) -> list[Job]:
    """The runs of a benchmark, clip by clip.

    Args:
        clips: recordings, each with settings of its own.
        modes: methods under their own names.
        masks: ``own`` (the preset's segmentation) and/or ``given`` (the recording's masks).
        starts: cold-start offsets in frames.
        config: preset or YAML file.
        overrides: settings for all runs.
        limit: at most this many frames per run.
        externals: name of a method outside this package -> its file of poses, ``{clip}`` standing for the clip's name.
        methods: methods under other names, each with a configuration of its own.

    Raises:
        UsageError: two clips, or two methods, have the same name; a file of poses is missing.
    """
    entries = [*(Entry(mode, mode, config) for mode in modes), *methods]
    names = [entry.name for entry in entries] + list(externals or {})
    if twice := {name for name in names if names.count(name) > 1}:
        raise UsageError(f"two methods are called {', '.join(sorted(twice))}: choose another name for one of them")
    jobs: dict[str, Job] = {}
    for spec, own_settings in clips:
        # A clip that is meant to be run with its own masks has no other.
        for mask in ("given",) if set(GIVEN_MASKS) <= set(own_settings) else masks:
            for start in starts:
                for entry in entries:
                    name = f"{spec.name}-{entry.name}-{mask}-{start}"
                    if name in jobs:
                        raise UsageError(f"two recordings are called {spec.name}: rename one of them")
                    given = GIVEN_MASKS if mask == "given" else ()
                    settings = (*overrides, *entry.settings, *own_settings, *given)
                    labels = _labels(spec, mask, start, entry.name) | {"method": entry.mode}
                    jobs[name] = Job(name, spec, entry.mode, entry.config, settings, start, limit, labels)
        for start in starts:
            for method, pattern in (externals or {}).items():
                job = _external_job(spec, method, pattern, config, start, limit)
                jobs[job.name] = job
    return list(jobs.values())


def _external_job(spec: SourceSpec, method: str, pattern: str, config: str, start: int, limit: int | None) -> Job:
    poses = Path(pattern.replace("{clip}", spec.name)).resolve()
    if not poses.exists():
        raise UsageError(f"--poses {method}: {poses} does not exist; use {{clip}} for the clip's name")
    labels = _labels(spec, "-", start, method)
    return Job(f"{spec.name}-{method}-{start}", spec, method, config, (), start, limit, labels, poses)


def _labels(spec: SourceSpec, masks: str, start: int, name: str) -> dict[str, str]:
    return {"group": spec.group, "clip": spec.name, "masks": masks, "start": str(start), "mode": name}


def bench_table(outcomes: Sequence[Outcome]) -> Table:
    """Accuracy, recall, masks, motion, stated confidence, speed and memory of every run."""
    return Table("Benchmark", (*_WHERE, *_FIGURES, Column("run", "run")), _rows(outcomes))


def stage_table(outcomes: Sequence[Outcome]) -> Table:
    """Mean time per frame by stage; a stage that runs at keyframes only is averaged over all frames."""
    return Table("Time per frame by stage", (*_WHERE, *_STAGES), _rows(outcomes))


def group_table(outcomes: Sequence[Outcome]) -> Table:
    """Figures per group (data set, or folder of clips): errors pooled over all frames, speed over all time."""
    keys = ("group", "masks", "start", "mode")
    groups: dict[tuple[str, ...], list[tuple[Path, dict[str, Any]]]] = {}
    methods: dict[tuple[str, ...], str | None] = {}
    for outcome in outcomes:
        if outcome.figures is not None:
            group = tuple(outcome.job.labels[key] for key in keys)
            groups.setdefault(group, []).append((outcome.folder, outcome.figures))
            methods.setdefault(group, outcome.job.labels.get("method"))
    rows = [
        {**dict(zip(keys, group, strict=True)), "method": methods[group], **_pooled(members)}
        for group, members in groups.items()
    ]
    columns = (
        Column("group", "group"),
        *_WHERE[1:],
        Column("clips", "clips", "d"),
        Column("targets", "frames", "d"),
        *(column for column in _FIGURES if column.key in _POOLED),
    )
    return Table("Benchmark by group", columns, rows)


_POOLED = {
    "E_p_mean",
    "E_p_sd",
    "E_t_m_mean",
    "E_t_m_sd",
    "E_q_deg_mean",
    "E_q_deg_sd",
    "E_q_over_90_share",
    "E_p_sym_mean",
    "coverage",
    "fps",
    "fps_without_detector",
}


def _pooled(runs: Sequence[tuple[Path, dict[str, Any]]]) -> dict[str, Any]:
    """Figures over all frames of several runs, from their folders and ``metrics.json``."""
    errors = np.vstack([read_errors(folder) for folder, _ in runs])
    targets = sum(figures["targets"] for _, figures in runs)
    return {
        **metrics.summarise(metrics.PoseErrors(errors[:, 0], np.radians(errors[:, 1]), errors[:, 2])),
        "E_p_sym_mean": float(np.nanmean(errors[:, 3])) if np.isfinite(errors[:, 3]).any() else float("nan"),
        "clips": len(runs),
        "targets": targets,
        "coverage": sum(figures["valid"] for _, figures in runs) / targets if targets else None,
        **{rate: _pooled_rate([figures for _, figures in runs], rate) for rate in ("fps", "fps_without_detector")},
    }


def _pooled_rate(runs: Sequence[Mapping[str, Any]], rate: str) -> float | None:
    """Frames per second over all runs that say theirs."""
    known = [(figures["frames"], figures[rate]) for figures in runs if figures.get(rate)]
    return sum(frames for frames, _ in known) / sum(frames / fps for frames, fps in known) if known else None


def failures(outcomes: Sequence[Outcome]) -> list[str]:
    """One line per failed run."""
    return [f"{outcome.job.name}: {outcome.failure}" for outcome in outcomes if outcome.figures is None]


def _rows(outcomes: Sequence[Outcome]) -> list[dict[str, Any]]:
    return [{**o.job.labels, **(o.figures or {}), "run": f"runs/{o.job.name}"} for o in outcomes]
