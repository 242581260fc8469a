"""Object lists of a simulated vehicle in real time, as lines of JSON for `cobevglue node`.

python examples/live_lists.py car1 60 | cobevglue node car1 --listen tcp/127.0.0.1:7447
"""

import contextlib
import sys
import time

from cobevglue.node import OwnList, write_list
from cobevglue.simulation import Junction, JunctionSettings


def main(agent: str = "car1", seconds: str = "2") -> None:
    frames = list(Junction(seed=3, settings=JunctionSettings(agents=8)))
    frames += frames[-2:0:-1]  # and backwards, so that nothing jumps
    begin = tick = round(10 * time.time())  # all agents are at the same frame at the same time
    while tick < begin + 10 * float(seconds):
        time.sleep(max(0.0, tick / 10 - time.time()))
        view = frames[tick % len(frames)].agents[agent]
        print(write_list(OwnList(view.boxes, tick / 10, view.body)), flush=True)
        tick += 1


if __name__ == "__main__":
    with contextlib.suppress(BrokenPipeError, KeyboardInterrupt):
        main(*sys.argv[1:])
