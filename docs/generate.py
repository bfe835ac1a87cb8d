"""Reference pages from the code: MkDocs calls the hooks at the end of this file while it builds the site.

A page says where a table goes by a comment, ``<!-- generated: topics -->``, and a file by ``<!-- file: PATH -->``. What
each topic is for stands here, since the code needs only its name and type; one that is missing here stops the build.
"""

from __future__ import annotations

import ast
import dataclasses
import re
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[1]
sys.path.insert(0, str(ROOT))

from hat_ros.config import HatConfig, config_to_dict, describe, flat_options, load_config, preset_names  # noqa: E402
from hat_ros.io import topics  # noqa: E402
from hat_ros.nets.checkpoint_registry import CHECKPOINTS  # noqa: E402
from hat_ros.types import StateReason  # noqa: E402

INPUTS, OUTPUTS, STAGES, PEOPLE, RUN = "Inputs", "Outputs", "Between the stages", "For people", "The run itself"
# Topic -> (group, from and to, how often, what it carries).
ABOUT: dict[str, tuple[str, str, str, str]] = {
    topics.IMAGE: (INPUTS, "camera to segmentation", "any", "image, see [Cameras](cameras.md); remap it"),
    topics.IMAGE_COMPRESSED: (INPUTS, "camera to segmentation", "any", "the same as JPEG, PNG, WebP or TIFF"),
    topics.CAMERA_INFO: (INPUTS, "camera to segmentation", "any", "calibration of the image; its distortion is undone"),
    topics.DETECTION_MASK: (
        INPUTS,
        "detector to segmentation",
        "any",
        "mono8: 255 silhouette, 128 box; read only with `segmentation.backend: annotated`",
    ),
    topics.INITIAL_POSE: (
        INPUTS,
        "navigation to segmentation, live",
        "any",
        "where the target is, roughly, with its covariance, see [Your own recording](tutorial.md)",
    ),
    topics.TARGET_POSE: (
        OUTPUTS,
        "fusion to GNC",
        "each frame that is TRACKING or COASTING",
        "the pose `T_cam_target`; of INITIALISING frames on request (`graph.publish_initialising`)",
    ),
    topics.TARGET_POSE_WITH_COVARIANCE: (
        OUTPUTS,
        "fusion to filters",
        "each frame that has a pose",
        "the pose and its covariance, see [Covariance](covariance.md)",
    ),
    topics.TF: (
        OUTPUTS,
        "fusion to all",
        "each frame that has a pose",
        "the pose as a transform, where `tf2_msgs` is installed",
    ),
    topics.STATUS: (
        OUTPUTS,
        "fusion to segmentation, hypotheses, slam, player and GNC",
        "one row per frame",
        "state, anchor, gaps and pose, see [States](states.md)",
    ),
    topics.DIAGNOSTICS: (OUTPUTS, "all nodes", "1 Hz and on change", "health of each node, with figures"),
    topics.HAT_CAMERA_INFO: (STAGES, "segmentation to all", "once, latched", "the calibration in use"),
    topics.ADMISSION: (STAGES, "segmentation to all", "one row per frame", "number and epoch of an admitted frame"),
    topics.GIVEN_POSE: (
        STAGES,
        "segmentation to hypotheses",
        "when one was given",
        "the initial pose that is in force from the frame of its stamp on",
    ),
    topics.FRAME: (
        STAGES,
        "segmentation to hypotheses, slam, fusion",
        "one per frame",
        "image with what segmentation found in the alpha channel",
    ),
    topics.HYPOTHESES_SCORED: (
        STAGES,
        "hypotheses to selector",
        "one table per frame",
        "candidates, no rows between keyframes",
    ),
    topics.SLAM_STATE: (STAGES, "slam to selector, fusion", "one row per frame", "relative motion `T_slam_cam`"),
    topics.SELECTION: (
        STAGES,
        "selector to fusion",
        "one table per frame",
        "candidates with path scores, one selected",
    ),
    topics.ALIGNMENT: (STAGES, "fusion to log", "on change, latched", "the similarity from SLAM to target"),
    topics.HYPOTHESES: (PEOPLE, "hypotheses", "keyframes", "candidates, best first"),
    topics.ANCHOR: (PEOPLE, "selector", "keyframes", "the selected candidate"),
    topics.SLAM_ODOMETRY: (PEOPLE, "slam", "when valid", "relative motion in `slam_<epoch>`, without scale"),
    topics.ALIGNMENT_TRANSFORM: (PEOPLE, "fusion", "on change, latched", "SLAM to target as a transform"),
    topics.OVERLAY: (PEOPLE, "overlay", "at most one per frame", "CAD outline on the image, if subscribed"),
    topics.READY: (RUN, "all nodes", "once, latched", "a node has all its partners"),
    topics.END_OF_STREAM: (RUN, "player to all", "once, latched", "the recording is over"),
}
# Quality of service by topic; others have REPLAY's. A test compares this with the profiles of the nodes.
LATCHED = "reliable, transient local, depth 1"
QOS: dict[str, str] = {
    **dict.fromkeys((topics.HAT_CAMERA_INFO, topics.ALIGNMENT, topics.ALIGNMENT_TRANSFORM), LATCHED),
    **dict.fromkeys((topics.READY, topics.END_OF_STREAM), LATCHED),
    **dict.fromkeys((topics.HYPOTHESES, topics.SLAM_ODOMETRY, topics.ANCHOR), "reliable, depth 10"),
    **dict.fromkeys((topics.TARGET_POSE, topics.TARGET_POSE_WITH_COVARIANCE), "reliable, depth 10"),
    topics.DIAGNOSTICS: "reliable, depth 10",
    topics.INITIAL_POSE: "reliable, depth 10",
    topics.TF: "reliable, depth 100",
    topics.OVERLAY: "best effort, depth 1",
}
STAGE_QOS = "reliable, depth 16"
LIVE_INPUT_QOS = "best available, depth 1"

TABLES: dict[str, tuple[str, ...]] = {
    topics.HYPOTHESES_SCORED: topics.CANDIDATE_COLUMNS,
    topics.SELECTION: topics.SELECTION_COLUMNS,
    topics.SLAM_STATE: topics.MOTION_COLUMNS,
    topics.ALIGNMENT: topics.ALIGNMENT_COLUMNS,
    topics.STATUS: topics.STATUS_COLUMNS,
    topics.ADMISSION: topics.ADMISSION_COLUMNS,
}


def topic_tables() -> str:
    """One Markdown table of topics per group."""
    parts = []
    for group in (INPUTS, OUTPUTS, STAGES, PEOPLE, RUN):
        rows = ["| Topic, type | From, to | What | How often | QoS |", "|---|---|---|---|---|"]
        for topic, kind in topics.TYPES.items():
            about, route, often, what = ABOUT[topic]
            if about == group:
                rows.append(f"| `{topic}`<br>`{kind}` | {route} | {what} | {often} | {qos_text(topic)} |")
        parts.append(f"## {group}\n\n" + "\n".join(rows))
    return "\n\n".join(parts)


def qos_text(topic: str) -> str:
    """Quality of service of a topic in words; inputs differ between a camera and a replay."""
    if ABOUT[topic][0] == INPUTS and topic not in QOS:
        return f"live: {LIVE_INPUT_QOS};<br>replay: {STAGE_QOS}"
    return QOS.get(topic, STAGE_QOS)


def column_lists() -> str:
    """Columns of every table topic, in order."""
    rows = ["| Topic | Columns, all FLOAT64 |", "|---|---|"]
    rows += [f"| `{topic}` | {' '.join(f'`{name}`' for name in columns)} |" for topic, columns in TABLES.items()]
    return "\n".join(rows)


def reason_table() -> str:
    """Number, name and words of every reason for a state."""
    rows = ["| Reason | Number | Words |", "|---|---|---|"]
    rows += [f"| `{reason.name}` | {reason.value} | {reason.words} |" for reason in StateReason]
    return "\n".join(rows)


def parameter_tables() -> str:
    """One Markdown table of parameters per section of the configuration, in order of declaration."""
    sections = _sections(HatConfig(), "")
    values = {name: value for name, (value, _) in flat_options(load_config("default")).items()}
    parts = []
    for prefix, section in sections:
        rows = [
            "| Key | Default | Accepts | Level | Meaning |",
            "|---|---|---|---|---|",
        ]
        for item in dataclasses.fields(section):
            name = f"{prefix}{item.name}"
            if name in values:
                rows.append(_parameter_row(name, values[name], item))
        if len(rows) > 2:
            doc = " ".join((type(section).__doc__ or "").split())
            parts.append(f"## {prefix.rstrip('.')}\n\n{doc}\n\n" + "\n".join(rows))
    return "\n\n".join(parts)


def _sections(section: Any, prefix: str) -> list[tuple[str, Any]]:
    found = [(prefix, section)] if prefix else []
    for item in dataclasses.fields(section):
        value = getattr(section, item.name)
        if dataclasses.is_dataclass(value):
            found += _sections(value, f"{prefix}{item.name}.")
    return found


def _parameter_row(name: str, value: Any, item: dataclasses.Field[Any]) -> str:
    about = item.metadata
    low, high = about.get("low"), about.get("high")
    bounds = [f"at least {low:g}" if low is not None else "", f"at most {high:g}" if high is not None else ""]
    accepts = ", ".join(f"`{word}`" for word in about.get("choices") or ()) or ", ".join(filter(None, bounds))
    cells = (f"`{name}`", f"`{_plain(value)}`", accepts, about["level"], describe(about))
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def _plain(value: Any) -> str:
    if isinstance(value, bool):
        return str(value).lower()
    return '""' if value == "" else str(value)


def preset_table() -> str:
    """What each preset changes of the default."""
    base = {name: value for name, (value, _) in flat_options(load_config("default")).items()}
    others = [name for name in preset_names() if name != "default"]
    configs = {name: {k: v for k, (v, _) in flat_options(load_config(name)).items()} for name in others}
    rows = [f"| Key | `default` | {' | '.join(f'`{name}`' for name in others)} |", "|---" * (len(others) + 2) + "|"]
    for key, value in base.items():
        if any(configs[name][key] != value for name in others):
            cells = [_plain(configs[name][key]) if configs[name][key] != value else "" for name in others]
            rows.append(f"| `{key}` | {_plain(value)} | {' | '.join(cells)} |")
    return "\n".join(rows)


def weight_table() -> str:
    """Name, size and licence of every public checkpoint."""
    rows = ["| Checkpoint | Size | Licence |", "|---|---|---|"]
    rows += [f"| `{item.name}` | {item.size} | {item.licence} |" for item in CHECKPOINTS.values()]
    return "\n".join(rows)


def launch_table() -> str:
    """Arguments of the launch file."""
    rows = ["| Argument | Default | Meaning |", "|---|---|---|"]
    arguments = _literal(ROOT / "launch" / "hat.launch.py", "ARGUMENTS")
    rows += [f"| `{name}` | `{_plain(value)}` | {doc} |" for name, value, doc in arguments]
    return "\n".join(rows)


def node_table() -> str:
    """Parameters of the nodes beside the configuration."""
    rows = ["| Parameter | Default | Meaning |", "|---|---|---|"]
    options = _literal(ROOT / "hat_ros" / "ros" / "params.py", "_RUN_OPTIONS")
    rows += [f"| `{name}` | `{_plain(value)}` | {doc} |" for name, (value, doc) in options.items()]
    return "\n".join(rows)


def room_order() -> str:
    """The rooms of the package from the ground up, as the test of imports has them."""
    floors = _literal(ROOT / "test" / "test_rooms.py", "FLOORS")
    return "\n".join(f"{n}. {', '.join(f'`{room}`' for room in rooms)}" for n, rooms in enumerate(floors, 1))


def _literal(path: Path, name: str) -> Any:
    """A constant of a module that cannot be imported here."""
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.Assign | ast.AnnAssign) and node.value is not None:
            targets = node.targets if isinstance(node, ast.Assign) else [node.target]
            if any(isinstance(target, ast.Name) and target.id == name for target in targets):
                return ast.literal_eval(node.value)
    raise LookupError(f"{path} has no constant {name}")


GENERATORS: dict[str, Callable[[], str]] = {
    "topics": topic_tables,
    "columns": column_lists,
    "reasons": reason_table,
    "parameters": parameter_tables,
    "presets": preset_table,
    "weights": weight_table,
    "launch": launch_table,
    "nodes": node_table,
    "rooms": room_order,
    "n_parameters": lambda: str(len(flat_options())),
    "n_sections": lambda: str(len(config_to_dict(HatConfig()))),
}
_MARK = re.compile(r"<!-- generated: (\w+) -->")
_FILE = re.compile(r"<!-- file: (\S+) -->")
_ROLE = re.compile(r":(?:class|mod|func|meth|attr|data|exc):<code>~?([^<]*)</code>")


def fill(markdown: str) -> str:
    """Markdown with every mark replaced by what it names."""
    markdown = _MARK.sub(lambda found: GENERATORS[found[1]](), markdown)
    return _FILE.sub(lambda found: _listing(ROOT / found[1]), markdown)


def _listing(path: Path) -> str:
    return f"```python\n{path.read_text(encoding='utf-8')}```"


def on_page_markdown(markdown: str, **_: Any) -> str:
    """MkDocs hook: the tables of a page."""
    return fill(markdown)


def on_page_content(html: str, **_: Any) -> str:
    """MkDocs hook: cross-references of docstrings as plain names."""
    return _ROLE.sub(r"<code>\1</code>", html)
