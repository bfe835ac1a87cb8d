"""`tools/mutate.py`: what it takes for a tuned constant, how it scales it, and that it leaves the checkout alone."""

import importlib.util
import subprocess
import sys
from pathlib import Path

import pytest
from gate_bands import BANDS

SOURCE = Path(__file__).parents[2] / "tools" / "mutate.py"


@pytest.fixture(scope="module")
def mutate():
    spec = importlib.util.spec_from_file_location("mutate", SOURCE)
    module = importlib.util.module_from_spec(spec)
    sys.modules["mutate"] = module  # dataclasses look their module up
    spec.loader.exec_module(module)
    yield module
    del sys.modules["mutate"]


def test_source_constants_are_numbers_at_module_level_that_are_tuned(mutate):
    source = b"""# \xc3\xa9
_FORMAT = 3
_A_SHARE, _B_PX = 0.5, 9  # of it
TURN_RAD: float = np.radians(2.0)
_PAIRS = ((1, 2.0), (3, 4.0))
_DERIVED = 2 * _A_SHARE
_ARRAY = np.ones(3)
_FLAG = True
lower = 4
def f():
    INNER = 5
"""
    found = list(mutate._in_source(source, "room/module.py"))
    assert [(c.name, c.value) for c in found] == [
        ("room/module._A_SHARE,_B_PX", (0.5, 9)),
        ("room/module.TURN_RAD", pytest.approx(0.0349065850)),
        ("room/module._PAIRS", ((1, 2.0), (3, 4.0))),
    ]
    assert source[slice(*found[0].span)] == b"0.5, 9"


@pytest.mark.parametrize(
    ("name", "value", "factor", "expected"),
    [
        ("_SHARE", 0.5, 1.4, 0.7),
        ("_COUNT", 2, 0.7, 1),
        ("_COUNT", 1, 0.7, 1),
        ("_WINDOW_PX", 17, 0.7, 11),  # odd stays odd
        ("_SCORE", -6, 0.7, -4),
        ("_RANGE_PERCENT", 99, 1.4, 100.0),
        ("_PAIRS", ((10, 0), 2.0), 1.4, ((14, 0), 2.8)),
    ],
)
def test_scaled_values_stay_usable(mutate, name, value, factor, expected):
    assert mutate.Constant(name, value).scaled(factor) == expected


def test_options_stay_within_what_they_accept(mutate):
    assert mutate.Constant("a.b", 10, low=8).scaled(0.7) == 8
    assert mutate.Constant("a.b", 0.9, high=1).scaled(1.4) == 1.0


def test_the_copy_has_the_scaled_values_and_the_checkout_has_not(mutate, tmp_path):
    stage = mutate.constants(mutate.STAGES["refinement and tracking"])
    names = {"refinement/covariance.OUTLINE_SIGMA_PX", "tracking/prior.JUMP_DEG", "refinement.min_margin"}
    chosen = [constant for constant in stage if constant.name in names]
    assert len(chosen) == 3
    folder = mutate.mutated_copy(tmp_path / "copy", chosen, 2.0)
    code = """if True:
        from hat_ros.config import load_config
        from hat_ros.refinement.covariance import OUTLINE_SIGMA_PX
        from hat_ros.tracking.prior import JUMP_DEG
        print(OUTLINE_SIGMA_PX, JUMP_DEG, load_config("default").refinement.min_margin)"""

    def values(path):
        command = [sys.executable, "-c", code]
        done = subprocess.run(
            command, cwd=path, env={"PYTHONPATH": str(path)}, capture_output=True, text=True, check=True
        )
        return [float(word) for word in done.stdout.split()]

    assert values(folder) == [2 * value for value in values(SOURCE.parents[1])]


def test_compiled_code_is_dropped_where_a_changed_constant_may_be_compiled_in(mutate, tmp_path):
    like = tmp_path / "like" / "hat_ros"
    texts = {
        "room/a.py": "_C = 2",
        "room/b.py": "from hat_ros.room.a import _C",
        "other/c.py": "from hat_ros.room import b",
        "other/d.py": "import numpy",
        "config/presets/default.yaml": "",
    }
    for path, text in texts.items():
        (like / path).parent.mkdir(parents=True, exist_ok=True)
        (like / path).write_text(text, encoding="utf-8")
    for path in ("room/a", "room/b", "other/c", "other/d"):
        compiled = like / Path(path).parent / "__pycache__" / f"{Path(path).name}.f-1.py311.nbi"
        compiled.parent.mkdir(exist_ok=True)
        compiled.touch()
    change = mutate.Constant("room/a._C", 2, "room/a.py", (5, 6))
    package = mutate.mutated_copy(tmp_path / "copy", [change], 1.4, tmp_path / "like") / "hat_ros"
    assert (package / "room/a.py").read_text(encoding="utf-8") == "_C = 3"
    assert (like / "room/a.py").read_text(encoding="utf-8") == "_C = 2"
    assert [path.name for path in package.rglob("*.nbi")] == ["d.f-1.py311.nbi"]


@pytest.mark.parametrize("factor", [0.7, 1.4])
def test_every_stage_has_constants_and_a_legal_copy(mutate, tmp_path, factor):
    for name, stage in mutate.STAGES.items():
        found = mutate.constants(stage)
        assert len(found) > 40 and len({constant.name for constant in found}) == len(found)
        folder = mutate.mutated_copy(tmp_path / name.replace(" ", "_"), found, factor)  # options are validated
        for path in {constant.path for constant in found if constant.path}:
            compile((folder / "hat_ros" / path).read_bytes(), path, "exec")


def test_the_report_is_read(mutate, tmp_path):
    def case(clip, left, failure=""):
        properties = {"clip": clip, "package": str(tmp_path / "hat_ros"), "poses": f"of {clip}", "left": left}
        items = "".join(f'<property name="{key}" value="{value}"/>' for key, value in properties.items() if value)
        return f'<testcase name="{clip}"><properties>{items}</properties>{failure}</testcase>'

    failure = '<failure message="AssertionError: x">text</failure>'
    crash = '<testcase name="clip3"><failure message="IndexError: y">text</failure></testcase>'
    report = tmp_path / "report.xml"
    report.write_text(f"<s>{case('clip1', '')}{case('clip2', 'mean_e_p', failure)}{crash}</s>", encoding="utf-8")
    verdict = mutate._read_report(report, tmp_path)
    assert verdict.clips == {"clip2": "mean_e_p", "clip3": "crash: IndexError: y"} and not verdict.crashed
    assert verdict.poses == {"clip1": "of clip1", "clip2": "of clip2"}
    same = mutate.Verdict({}, {name: name for name in BANDS})
    assert mutate._judge(same, same) == ("no pose changed", True)
    text, good = mutate._judge(mutate.Verdict({}, same.poses | {"demo": "other"}), same)
    assert "GREEN" in text and not good
