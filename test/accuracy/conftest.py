"""The table of the accuracy gate, after the tests."""

import pytest

TABLE = pytest.StashKey[list[str]]()


@pytest.fixture
def table(request: pytest.FixtureRequest) -> list[str]:
    """Lines that are printed when all tests are done, whatever came of them."""
    return request.config.stash.setdefault(TABLE, [])


def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter, config: pytest.Config) -> None:
    lines = config.stash.get(TABLE, [])
    if lines:
        terminalreporter.section("accuracy of the default preset: measured (band)")
        terminalreporter.write_line("\n".join(lines))
