"""``pp-collect bags``: rosbag2 recordings of a robot as a LeRobot v3 set at its control rate (docs/data.md)."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Literal

import tyro
from tqdm import tqdm

from dual_system.data.errors import DatasetError
from dual_system.data.lerobot_files import INFO_PATH
from dual_system.data.recording import RecordingWriter
from dual_system.data.rosbag import read_bag_mapping, recording_of_bag
from protocol import files
from protocol.command_line import On, command, parse
from protocol.errors import FileError
from sim_client.robot_file import read_robot


@dataclass(frozen=True, slots=True, kw_only=True)
class BagOptions:
    """Turns rosbag2 recordings in MCAP, one episode each, into a LeRobot v3 dataset of one robot."""

    bags: tyro.conf.Positional[tuple[Path, ...]]
    """MCAP files, or rosbag2's folders."""
    robot_file: Path
    """The robot's file (docs/robots.md): its names, order, rate and limits hold."""
    mapping: Path
    """TOML file that names the topics (docs/data.md)."""
    out: Path
    """Folder of the new dataset."""
    unfit: Literal["refuse", "leave-out"] = "refuse"
    """A bag with a gap, without a topic or cut. refuse: stop and name it; leave-out: go on without it and say why."""
    progress: On = True
    """Do not show a progress bar."""


@command("pp-collect bags")
def main(argv: list[str] | None = None, prog: str = "pp-collect bags") -> int:
    options = parse(BagOptions, argv, prog=prog)
    num_episodes, left_out = write_bags(options)
    for told in left_out:
        sys.stderr.write(f"{prog}: left out: {told}\n")
    sys.stdout.write(f"{num_episodes} of {len(options.bags)} bags in {options.out}\n")
    return 0


def write_bags(options: BagOptions) -> tuple[int, list[str]]:
    """Writes the dataset; returns the number of its episodes, and why bags were left out.

    Raises:
        DatasetError: there is a dataset already, nothing is left to write, or a bag is unfit.
        OSError, FileError: a file cannot be read, or is not what it should be.
    """
    if (options.out / INFO_PATH).exists():
        raise DatasetError(f"{options.out} holds a dataset already; use another --out")
    robot, mapping = read_robot(options.robot_file).robot, read_bag_mapping(options.mapping)
    writer, num_episodes, left_out = RecordingWriter(files.folder(options.out)), 0, list[str]()
    for path in tqdm(options.bags, unit="bag", disable=not options.progress):
        try:
            with files.writing(options.out):
                writer.add(recording_of_bag(path, mapping, robot))
        except (DatasetError, FileError) as error:
            if options.unfit == "refuse":
                raise
            left_out.append(str(error))
            continue
        num_episodes += 1
    if not num_episodes:
        raise DatasetError(f"nothing to write: {'; '.join(left_out) or 'name at least one bag'}")
    with files.writing(options.out):
        writer.finish()
    return num_episodes, left_out


if __name__ == "__main__":
    sys.exit(main())
