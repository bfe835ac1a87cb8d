"""What is counted and timed: stages by their wrapper, networks by hooks, other parts by spans."""

import pytest

from hat_ros.bench.experiments.meter import CONSTRUCTION, Meter
from hat_ros.spans import listening, span


class Stage:
    tag = "its own"

    def update(self, batch):
        with span("renders", len(batch)):
            if not batch:
                raise ValueError("empty")
        return sum(batch)


def test_stages_and_their_spans_are_counted_and_the_rest_of_a_stage_is_its_own():
    waits = []
    meter = Meter(lambda: waits.append(1))
    stage = meter.wrap("hypotheses", Stage())
    assert stage.tag == "its own"
    with listening(meter.part):
        assert stage.update([1, 2, 3]) == 6
        with pytest.raises(ValueError, match="empty"):
            stage.update([])
    tallies = meter.take()
    assert (tallies["hypotheses"].calls, tallies["renders"].calls, tallies["renders"].images) == (2, 2, 3)
    assert tallies["hypotheses"].seconds >= tallies["renders"].seconds > 0
    assert len(waits) == 8, "before and after each of the two stages and spans"
    assert meter.rows() == [(CONSTRUCTION, CONSTRUCTION), ("hypotheses", "hypotheses"), ("renders", "  renders")]
    assert meter.take() == {}


def test_nothing_is_measured_when_no_one_listens():
    meter = Meter(lambda: None)
    with listening(meter.part):
        pass
    Stage().update([1])
    assert meter.take() == {}


def test_a_part_that_construction_uses_as_well_stands_with_its_stage():
    meter = Meter(lambda: None)
    stage = meter.wrap("hypotheses", Stage())
    with listening(meter.part), meter.stage(CONSTRUCTION), span("renders", 7), span("templates"):
        pass
    assert [name for name, _ in meter.rows()] == [CONSTRUCTION, "renders", "templates", "hypotheses"]
    with listening(meter.part):
        stage.update([1])
    assert [name for name, _ in meter.rows()] == [CONSTRUCTION, "templates", "hypotheses", "renders"]


def test_of_nested_networks_the_outermost_counts_with_its_images():
    torch = pytest.importorskip("torch")

    class Encoder(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.layer = torch.nn.Linear(2, 2)

        def forward(self, batch):
            if len(batch) > 4:
                raise ValueError("too many")
            return self.layer(batch)

    class _Network(torch.nn.Module):
        def __init__(self):
            super().__init__()
            self.encoder = Encoder()

        def forward(self, batches, *, factor):
            return factor * self.encoder(batches[0])

    meter, network = Meter(lambda: None), _Network()
    with meter.networks():
        network([torch.zeros(3, 2)], factor=2)
        with pytest.raises(ValueError, match="too many"):
            network([torch.zeros(5, 2)], factor=2)
        network.encoder(torch.zeros(4, 2))
        network.encoder.layer(torch.zeros(4, 2))
    network([torch.zeros(3, 2)], factor=2)
    tallies = {name: (tally.calls, tally.images) for name, tally in meter.take().items()}
    assert tallies == {"Network": (2, 8), "Encoder": (1, 4)}
