"""``sim-client``: episodes from the command line."""

from __future__ import annotations

import sys
from typing import Any

from tqdm import tqdm

import dual_system.tasks.headless  # noqa: F401 - before anything that imports mujoco

# isort: split

from dual_system.tasks.seeds import require_open
from protocol import files
from protocol.command_line import command, parse
from protocol.logs import set_up_logging
from sim_client.config import SimOptions
from sim_client.harness import open_harness
from sim_client.launch import Daemons
from sim_client.suite import Suite
from sim_client.worlds import names, require


@command("sim-client")
def main(argv: list[str] | None = None) -> int:
    options = parse(SimOptions, argv, prog="sim-client")
    set_up_logging("WARNING")
    if options.list_tasks:
        print("\n".join(names()))
        return 0
    try:
        require(options.task)  # a mistyped name before anything is started
        for seed in range(options.seed, options.seed + options.episodes):
            require_open(seed, "pp-eval --split test plays them, and its results say so")
        with Daemons(files.folder(options.out)) as daemons:
            results, unwritten = _run(options, daemons)
    except KeyboardInterrupt:
        print(
            "sim-client: interrupted; logs are closed, and finished episodes, if any, are in results.json",
            file=sys.stderr,
        )
        return 130
    episodes = results["episodes"]
    for episode in episodes:
        print(
            f"{episode['task']} seed={episode['seed']} {episode['status']} steps={episode['steps']} {episode['reason']}"
        )
    print(f"{sum(e['success'] for e in episodes)} of {len(episodes)} succeeded; {options.out / 'results.json'}")
    if unwritten is not None:
        raise unwritten
    return 1 if any(e["status"] == "ABORTED" for e in episodes) else 0


def _run(options: SimOptions, daemons: Daemons) -> tuple[dict[str, Any], OSError | None]:
    """Returns the results, and why they are not on the disk."""
    most_ticks = options.schedule.max_steps
    with tqdm(total=options.episodes * most_ticks, unit="tick", disable=not options.log.progress) as bar:
        bar.bar_format = "{desc}"  # until there are ticks, a rate means nothing
        bar.set_description_str("waiting for servers" if options.policy == "servers" else "drawing the scene")
        harness = open_harness(options, daemons)

        def on_tick(episode: int, tick: int) -> None:
            if bar.bar_format is not None:
                bar.bar_format = None
                bar.unpause()
            bar.set_description(f"episode {episode + 1}/{options.episodes}", refresh=False)
            bar.update(episode * most_ticks + tick - bar.n)

        try:
            suite = Suite(options, harness.link, harness.clock, daemons.dead)
            return suite.run(on_tick), suite.unwritten
        finally:
            harness.bus.close()


if __name__ == "__main__":
    sys.exit(main())
