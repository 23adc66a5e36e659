"""Every frame of a run accounted for: what went in came out, or was dropped for a cause, whatever was restarted."""

from __future__ import annotations

import dataclasses
from collections import Counter

from steadypose.msgs.topics import DIAGNOSTICS
from steadypose.msgs.types import Diagnostics
from steadypose.nodes.graph.launch import Launch
from steadypose.nodes.graph.topology import NODES, Delivery

LOSSES = ("dropped.", "refused.")
"""begin the counts of what did not go through a node"""


class Ledger:
    """The counts of a run's nodes. A node that is started again counts from 0; here its counts go on.

    Args:
        launch: of the run.
    """

    def __init__(self, launch: Launch) -> None:
        self._launch = launch
        # a lossless node counts on itself from what the one before it had published
        self._restarted = LOSSES if launch.transport.lossless else (*LOSSES, "in.", "count.")
        self._before: dict[str, Counter[str]] = {}
        self._latest: dict[str, Diagnostics] = {}
        self._restarts: Counter[str] = Counter()

    def note(self, diagnostics: Diagnostics, restarts: int) -> Diagnostics:
        """Take a report of a node that was restarted so often; the report with the counts of all its processes."""
        node = diagnostics.node
        before = self._before.setdefault(node, Counter())
        if restarts != self._restarts[node] and node in self._latest:
            before.update(self._counts(self._latest[node]))
        self._restarts[node], self._latest[node] = restarts, diagnostics
        total = before + self._counts(diagnostics)
        return dataclasses.replace(diagnostics, values=diagnostics.values | {key: str(n) for key, n in total.items()})

    def _counts(self, diagnostics: Diagnostics) -> Counter[str]:
        return Counter({k: int(n) for k, n in diagnostics.values.items() if k.startswith(self._restarted)})

    def away(self, node: str, reports: dict[str, Diagnostics]) -> dict[str, str]:
        """What was published for a node while it was not there, by topic, from the last reports of all.

        A node that was killed had up to a second to say what it had taken, so this is of that accuracy.
        """
        declared = NODES[node]
        if self._launch.transport.lossless or declared.delivery is Delivery.BEST_EFFORT or node not in reports:
            return {}
        values = {key: int(n) for key, n in reports[node].values.items() if key.startswith((*LOSSES, "in."))}
        found = {}
        for publisher, topics in declared.subscribes.items():
            if publisher not in reports or not self._restarts[node] + self._restarts[publisher]:
                continue
            for topic in set(topics) - {DIAGNOSTICS}:
                causes = (f"in.{topic}", f"dropped.lost {topic}", f"dropped.expired {topic}", "dropped.late")
                accounted = sum(values.get(cause, 0) for cause in causes)
                missing = int(reports[publisher].values.get(f"count.{topic}", 0)) - accounted
                if missing > 0:
                    found[f"dropped.away {topic}"] = str(missing)
        return found


def losses(diagnostics: Diagnostics, *kinds: str) -> str:
    """What a node says that it dropped or refused, as a text; empty if nothing."""
    values = diagnostics.values.items()
    return ", ".join(f"{key} {n}" for key, n in values if key.startswith(kinds) and n != "0")
