"""Documentation that is held against the code: reference tables, quoted errors, links, words."""

import ast
import importlib.util
import re
from pathlib import Path

import pytest
import yaml

import hat_ros
from hat_ros.config import flat_options
from hat_ros.io import compressed, topics
from hat_ros.io.encodings import encoding_names
from hat_ros.io.lens import MODELS

ROOT = Path(__file__).parents[1]
PAGES = sorted([*ROOT.glob("docs/*.md"), ROOT / "README.md", ROOT / "CONTRIBUTING.md", ROOT / "bags" / "README.md"])


def generator():
    spec = importlib.util.spec_from_file_location("generate", ROOT / "docs" / "generate.py")
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


GENERATE = generator()


def read(path: Path) -> str:
    return path.read_text(encoding="utf-8")


def test_every_topic_is_in_the_reference():
    page = GENERATE.fill(read(ROOT / "docs" / "topics.md"))
    for topic, kind in topics.TYPES.items():
        assert f"| `{topic}`<br>`{kind}` |" in page
    assert set(GENERATE.ABOUT) == set(topics.TYPES)
    assert "generated:" not in page


def test_every_table_topic_has_its_columns():
    lists = [value for name, value in vars(topics).items() if name.endswith("_COLUMNS") and name != "POSE_COLUMNS"]
    assert sorted(GENERATE.TABLES.values()) == sorted(set(lists) - {()})


def test_quality_of_service_is_that_of_the_nodes():
    qos = pytest.importorskip("hat_ros.ros.qos")
    words = {"RELIABLE": "reliable", "BEST_EFFORT": "best effort", "BEST_AVAILABLE": "best available"}

    def described(profile):
        latched = ", transient local" if profile.durability.name == "TRANSIENT_LOCAL" else ""
        return f"{words[profile.reliability.name]}{latched}, depth {profile.depth}"

    for topic in topics.TYPES:
        if GENERATE.ABOUT[topic][0] == GENERATE.INPUTS:
            live, replay = described(qos.profile_of(topic, live=True)), described(qos.profile_of(topic))
            text = live if live == replay else f"live: {live};<br>replay: {replay}"
            assert GENERATE.qos_text(topic) == text
        else:
            assert GENERATE.qos_text(topic) == described(qos.profile_of(topic))


def test_every_parameter_is_in_the_reference():
    page = GENERATE.fill(read(ROOT / "docs" / "parameters.md"))
    for name, (_, field) in flat_options().items():
        row = next(
            line for line in page.splitlines() if line.startswith(f"| `{name}` |") and field.metadata["doc"] in line
        )
        assert row.count(" | ") == 4


def sentences() -> set[str]:
    """Every string of the package as a reader sees it: literals joined, values as an ellipsis."""
    found = set()
    for path in (ROOT / "hat_ros").rglob("*.py"):
        for node in ast.walk(ast.parse(read(path))):
            if isinstance(node, ast.Constant) and isinstance(node.value, str):
                found.add(node.value)
            elif isinstance(node, ast.JoinedStr):
                parts = (part.value if isinstance(part, ast.Constant) else "…" for part in node.values)
                found.add("".join(parts))
    return found


def quoted_errors() -> list[str]:
    text = read(ROOT / "docs" / "troubleshooting.md").split("## No error, but no pose")[0]
    rows = [line for line in text.splitlines() if line.startswith("| `")]
    return [re.match(r"\| `(.*?)` \| ", row)[1] for row in rows]


@pytest.fixture(scope="module")
def source_sentences() -> list[str]:
    return [re.sub("…+", "…", text) for text in sentences()]


def test_troubleshooting_quotes_something():
    assert len(quoted_errors()) > 30


@pytest.mark.parametrize("quoted", quoted_errors())
def test_quoted_error_is_in_the_source(quoted, source_sentences):
    # An ellipsis of the page may stand for constant text as well, such as the name of an option.
    pattern = re.compile(".*?".join(re.escape(part) for part in quoted.split("…")))
    assert any(pattern.search(text) for text in source_sentences), quoted


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_links_lead_somewhere(page):
    text = re.sub(r"```.*?```", "", read(page), flags=re.DOTALL)
    for target in re.findall(r"\]\(([^)#\s]+)[^)]*\)", text):
        assert target.startswith("https://") or (page.parent / target).exists(), target


def test_pages_are_in_the_navigation_once():
    listed = re.findall(r"(\w+\.md)", read(ROOT / "mkdocs.yml"))
    assert sorted(listed) == sorted(path.name for path in ROOT.glob("docs/*.md"))


def test_site_fetches_nothing():
    text = read(ROOT / "mkdocs.yml")
    assert "font: false" in text
    assert "http" not in text


def test_every_public_name_is_on_the_library_page():
    page = read(ROOT / "docs" / "library.md")
    named = {line.rsplit(".", 1)[1] for line in page.splitlines() if line.startswith("::: hat_ros.")}
    assert set(hat_ros.__all__) <= named


def test_readme_stays_short():
    lines = read(ROOT / "README.md").splitlines()
    assert len(lines) <= 150
    assert (ROOT / "docs" / "demo.webp").stat().st_size < 1_500_000


# Images where the field has terms.
IMAGES = re.compile(
    r"\b(vouch\w*|witness\w*|rival\w*|overthrow\w*|glances?|rehears\w*|nobody|somebody|in vain|hindsight|barely won)\b",
    re.I,
)


@pytest.mark.parametrize("page", PAGES, ids=lambda path: str(path.relative_to(ROOT)))
def test_pages_use_the_fields_terms(page):
    assert not IMAGES.search(read(page)), IMAGES.search(read(page))[0]


def test_citation_names_the_paper():
    citation = yaml.safe_load(read(ROOT / "CITATION.cff"))
    assert citation["preferred-citation"]["title"] in read(ROOT / "docs" / "citing.md").replace("\n> ", " ")
    assert "arXiv:2609.21597" in str(citation["preferred-citation"]["identifiers"])


def test_launch_arguments_and_node_parameters_are_in_the_reference():
    params = pytest.importorskip("hat_ros.ros.params")
    page = GENERATE.fill(read(ROOT / "docs" / "parameters.md"))
    for name, (_, doc) in params._RUN_OPTIONS.items():
        assert re.search(rf"\| `{name}` \| `.*` \| {re.escape(doc)} \|", page)
    assert "| `camera_info` | `camera_info` |" in page


def test_encodings_and_formats_of_the_cameras_page_are_those_that_are_read():
    sections = dict(part.split("\n", 1) for part in read(ROOT / "docs" / "cameras.md").split("\n## ")[1:])
    rows = [line.split(" | ")[0] for line in sections["Encodings"].splitlines() if line.startswith("| `")]
    listed = [name for row in rows for name in re.findall(r"`(\w+)`", row)]
    assert sorted(listed) == sorted((*encoding_names(), *compressed.FORMATS))


def test_lens_models_of_the_cameras_page_are_those_that_are_undone():
    text = re.search(r"The models are (.*?)\. Given", read(ROOT / "docs" / "cameras.md"), re.DOTALL)[1]
    assert sorted(re.findall(r"`(\w+)`", text)) == sorted(MODELS)
