"""Draw the picture of docs/node.md: how a node handles the messages of an agent with faults of every kind.

python tools/draw_node.py            # writes docs/images/node.png
"""

from __future__ import annotations

from collections import deque
from pathlib import Path

import numpy as np

from cobevglue.node import NodeCore, Outgoing, OwnList
from cobevglue.simulation import Junction, JunctionSettings
from cobevglue.visualization.style import EGO, MATCH, OTHER, TRUTH, add_axes, light_grid, new_figure, save_figure

PICTURE = Path(__file__).parents[1] / "docs" / "images" / "node.png"
KINDS = ("used", "out of order", "duplicate", "corrupted", "old session", "second agent", "late")
PARTS = (
    (0.0, "all is well"),
    (4.0, "lost, doubled,\nreordered"),
    (8.0, "every other\none damaged"),
    (12.0, "killed"),
    (15.0, "back; its first\nrun is replayed"),
    (19.0, "another agent\nwith its id"),
    (23.0, "1 s late"),
    (27.0, "all is well"),
)
END = 30.0


def main() -> None:
    """Run a node on a drive through the junction and draw the received messages and the verdicts."""
    frames = list(Junction(3, JunctionSettings(agents=3)))
    frames = [*frames, *frames[-2:0:-1]]
    ego, other, twin = NodeCore("car1", 1), NodeCore("car2", 100), NodeCore("car2", 300)
    rng = np.random.default_rng([0, 1, 0])
    recorded: list[Outgoing] = []
    line: deque[Outgoing] = deque()
    dots: list[tuple[float, str]] = []
    verdicts: list[tuple[float, str]] = []
    for step in range(round(10 * END)):
        now, frame = 0.1 * step, frames[step % len(frames)]
        part = sum(begin <= now + 1e-9 for begin, _ in PARTS) - 1
        arriving: list[tuple[bytes, bytes]] = []
        if part == 4 and other.session == 100:
            other = NodeCore("car2", 200)
        if part != 3:
            sent = other.observe(OwnList(frame.agents["car2"].boxes, now, frame.agents["car2"].body), now)
            pair = sent.data, sent.header
            if part == 1:
                draw = rng.random()
                arriving = [] if draw < 0.25 else [pair] * (2 if draw > 0.8 else 1)
                if line:
                    last = line.popleft()
                    arriving.append((last.data, last.header))
                elif draw < 0.15:
                    line.append(sent)
            elif part == 2 and step % 2:
                arriving = [(sent.data[:60] + b"?" + sent.data[61:], sent.header)]
            elif part == 6:
                line.append(sent)
                if len(line) > 10:
                    late = line.popleft()
                    arriving = [(late.data, late.header)]
            else:
                arriving = [pair]
            if part == 0:
                recorded.append(sent)
            if part == 4:
                arriving.append((recorded[step % len(recorded)].data, recorded[step % len(recorded)].header))
            if part == 5:
                more = twin.observe(OwnList(frame.agents["car3"].boxes, now, frame.agents["car3"].body), now)
                arriving.append((more.data, more.header))
        dots += [(now, ego.receive(data, now, header) or "used") for data, header in arriving]
        ego.observe(OwnList(frame.agents["car1"].boxes, now, frame.agents["car1"].body), now)
        result = ego.align(now)
        assert result is not None
        found = result.alignments.get("car2")
        verdicts.append((now, "" if found is None else "accepted" if found.accepted else "refused"))
    draw_picture(dots, verdicts)


def draw_picture(dots: list[tuple[float, str]], verdicts: list[tuple[float, str]]) -> None:
    """Draw the messages by outcome, above the alignment's verdicts."""
    figure = new_figure(11.0, 4.2)
    messages, verdict = add_axes(figure, 2, 1, heights=[6.0, 1.0])
    for row, kind in enumerate(KINDS):
        times = [time for time, what in dots if what == kind]
        messages.plot(times, [row] * len(times), "o", markersize=3.5, color=EGO if kind == "used" else OTHER)
    assert {what for _, what in dots} <= set(KINDS)
    messages.set_yticks(range(len(KINDS)), KINDS)
    messages.set_ylim(len(KINDS) - 0.5, -0.6)
    for begin, text in PARTS:
        for axes in (messages, verdict):
            axes.axvline(begin, color="#999999", linewidth=0.8)
        messages.annotate(text, (begin, 1.02), xycoords=("data", "axes fraction"), fontsize=8.5, color="#444444")
    colors = {"accepted": MATCH, "refused": OTHER, "": TRUTH}
    for time, what in verdicts:
        verdict.axvspan(time, time + 0.1, color=colors[what], alpha=0.9 if what else 0.25, linewidth=0)
    verdict.set_yticks([0.5], ["pose"])
    for axes in (messages, verdict):
        axes.set_xlim(0.0, END)
        light_grid(axes)
    messages.tick_params(labelbottom=False)
    verdict.set_xlabel("time [s]   (pose of car2: green accepted, orange refused)")
    save_figure(figure, PICTURE)


if __name__ == "__main__":
    main()
