from collections.abc import Callable

import pytest

from steadypose.msgs.types import Diagnostics, Level
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.run_state import Ledger


def report(node: str, **values: int) -> Diagnostics:
    named = {key.replace("__", ".", 1).replace("__", "/"): str(value) for key, value in values.items()}
    return Diagnostics(0, node, Level.OK, "", named)


@pytest.mark.parametrize("lossless", ["true", "false"])
def test_what_was_dropped_before_a_restart_stays_dropped(make_launch: Callable[..., Launch], lossless: str) -> None:
    ledger = Ledger(make_launch(transport__lossless=lossless))
    ledger.note(report("prior", dropped__late=2, count__pose__clean=10), 0)
    ledger.note(report("prior", dropped__late=3, count__pose__clean=20), 0)
    after = ledger.note(report("prior", dropped__late=1, count__pose__clean=25), 1)
    assert after.values["dropped.late"] == "4"
    # a lossless node counts on itself
    assert after.values["count.pose/clean"] == {"true": "25", "false": "45"}[lossless]


def test_a_live_stream_is_published_for_nobody_while_a_node_is_away(make_launch: Callable[..., Launch]) -> None:
    ledger = Ledger(make_launch(transport__lossless="false"))
    reports = {
        "pose_input": ledger.note(report("pose_input", count__pose__raw=100), 0),
        "prior": ledger.note(report("prior", in__pose__raw=30, dropped__late=5), 0),
    }
    assert not ledger.away("prior", reports), "it is only on its way"
    reports["prior"] = ledger.note(report("prior", in__pose__raw=40), 1)
    assert ledger.away("prior", reports) == {"dropped.away pose/raw": "25"}
