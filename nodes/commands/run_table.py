"""The table of a run: how fast, how late, what went wrong, of each node."""

from rich.console import Group
from rich.table import Table
from rich.text import Text

from steadypose.msgs.types import Diagnostics, Level
from steadypose.nodes.checks.problem import from_values
from steadypose.nodes.graph.clock import FRAME_NS
from steadypose.nodes.graph.supervisor import Supervisor
from steadypose.nodes.graph.topology import NODES
from steadypose.nodes.settings import printable

LEAST = ("in", "queue", "MB", "delay\nms", "compute ms\np50/p99", "joints\ngated", "bodies", "frames")
"""columns that are left out where not all fit, in this order"""
WIDTH = 80  # of `lines`, characters


def table(
    nodes: list[str], diagnostics: dict[str, Diagnostics], supervisor: Supervisor, width: int, *, summary: bool = False
) -> Group:
    """A row for each node: rate, latency, losses and memory.

    Empty columns are left out, and then those that do not fit into ``width`` characters. The rates of a ``summary`` are
    over the whole run.
    """
    rows, notes = [], []
    for name in nodes:
        child = supervisor.children[name]
        latest = diagnostics.get(name)
        values = latest.values if latest else {}
        topic = NODES[name].stream
        state = _state(child.state, values)
        if child.state == "stale":  # what it said before does not hold any more
            values = {}
        delay = values.get("delay_frames")
        rows.append(
            {
                "node": name,
                "state": state.partition(" ")[0],
                "in": str(_sum(values, "in.")) if topic else "",
                "frames": values.get(f"count.{topic}") or values.get("written", ""),
                "Hz": _short(values.get(f"mean_rate.{topic}" if summary else f"rate.{topic}"), 1),
                "latency ms\np50/p99": _pair(values, "latency_ms"),
                "compute ms\np50/p99": _pair(values, "compute_ms"),
                "delay\nms": f"{int(delay) * FRAME_NS / 1e6:.0f}" if delay else "",
                "bodies": values.get("bodies", ""),
                "joints\ngated": values.get("gate.joints_refused", "0"),
                "flagged": values.get("anomalies", "0"),
                "queue": values.get("queue", ""),
                "dropped": str(_sum(values, "dropped.")),
                "refused": str(_sum(values, "refused.")),
                "restarts": str(child.restarts),
                "MB": _short(values.get("memory_mb"), 0),
            }
        )
        if " " in state:
            notes.append(Text(printable(f"{name}: {state}")))
        if latest and not summary:
            style = "bold red" if latest.level == Level.ERROR else "yellow"
            notes += [Text(f"{name}: {text}", style=style) for text in from_values(values).values()]
        causes = [f"{key} {n}" for key, n in values.items() if key.startswith(("dropped.", "refused."))]
        if latest and causes and (summary or latest.level != Level.OK):
            notes.append(Text(printable(f"{name}: {', '.join(causes)}"), style="yellow"))
    grid = Table(box=None, header_style="bold", pad_edge=False)
    shown = [heading for heading in rows[0] if any(row[heading] not in ("", "0") for row in rows)]
    for least in LEAST:
        cells = ([key, *(row[key] for row in rows)] for key in shown)
        if sum(max(map(len, "\n".join(column).split("\n"))) + 2 for column in cells) <= width:
            break
        shown = [heading for heading in shown if heading != least]
    for heading in shown:
        grid.add_column(heading, justify="left" if heading in ("node", "state") else "right", no_wrap=True)
    for row in rows:
        grid.add_row(*(row[str(column.header)] for column in grid.columns))
    return Group(grid, *notes)


def lines(nodes: list[str], diagnostics: dict[str, Diagnostics], supervisor: Supervisor) -> list[str]:
    """The gist of `table`: as few lines as fit into `WIDTH` characters, of which all but the first are indented."""
    parts = []
    for name in nodes:
        values = diagnostics[name].values if name in diagnostics else {}
        topic = NODES[name].stream
        problems = "".join(f", {cause}" for cause in from_values(values))
        stale = supervisor.children[name].state == "stale"
        if stale or topic is None or f"rate.{topic}" not in values:
            parts.append(f"{name} {_state(supervisor.children[name].state, values)}{'' if stale else problems}")
            continue
        late = _pair(values, "latency_ms")
        trouble = _sum(values, "dropped."), _sum(values, "refused.")
        parts.append(
            f"{topic} {_short(values[f'rate.{topic}'], 1)} Hz"
            + (f", latency p50/p99 {late} ms" if late else "")
            + (f", {trouble[0]} dropped, {trouble[1]} refused" if any(trouble) else "")
            + problems
        )
    found = [parts[0]]
    for part in parts[1:]:
        fits = len(found[-1]) + 3 + len(part) <= WIDTH
        found[-1:] = [f"{found[-1]} | {part}"] if fits else [found[-1], f"  {part}"]
    return found


def _state(process: str, values: dict[str, str]) -> str:
    return values.get("state", "starting") if process == "running" else process


def _short(number: str | None, digits: int) -> str:
    return "" if number is None else f"{float(number):.{digits}f}"


def _pair(values: dict[str, str], name: str) -> str:
    if f"{name}.p50" not in values:
        return ""
    return f"{_short(values[f'{name}.p50'], 1)}/{_short(values[f'{name}.p99'], 1)}"


def _sum(values: dict[str, str], prefix: str) -> int:
    return sum(int(value) for key, value in values.items() if key.startswith(prefix))
