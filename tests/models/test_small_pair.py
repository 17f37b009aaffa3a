"""The shipped pair loads as it was saved, and nothing but its folders needs what was made for it."""

from __future__ import annotations

import json
import subprocess
import sys
from dataclasses import asdict
from pathlib import Path

import pytest

from dual_system.models.ponder.checkpoint import StoredPonder, load_ponder, save_ponder, weights_hash
from dual_system.models.ponder.network import Ponder
from dual_system.models.ponder.observation import check_cameras
from dual_system.models.pounce.checkpoint import PounceBundle, load_bundle, save_bundle
from dual_system.models.small_pair.reading import CropReader

SHIPPED = Path(__file__).parents[2] / "checkpoints" / "small"


@pytest.fixture(scope="module")
def ponder() -> Ponder:
    return load_ponder(SHIPPED / "ponder")


@pytest.fixture(scope="module")
def pounce() -> PounceBundle:
    return load_bundle(SHIPPED / "pounce")


def test_the_shipped_ponder_declares_how_it_reads(ponder: Ponder) -> None:
    declared = json.loads((SHIPPED / "ponder" / "ponder.json").read_text())["small_pair"]
    assert ponder.format.reader == CropReader(**declared | {"box": tuple(declared["box"])})


@pytest.mark.parametrize("px", [128, 256])
def test_the_shipped_ponder_reads_the_cameras_of_the_tasks(ponder: Ponder, px: int) -> None:
    check_cameras([(px, px)] * 2, ponder.format.reader, ponder.image_px)


def test_the_shipped_ponder_survives_its_folder(ponder: Ponder, tmp_path: Path) -> None:
    save_ponder(ponder, tmp_path)
    again = load_ponder(tmp_path)
    assert again.format.vocabulary.encode("pick up the cube") == ponder.format.vocabulary.encode("pick up the cube")
    assert again.format.reader == ponder.format.reader
    assert (again.image_px, again.is_random) == (ponder.image_px, False)
    assert weights_hash(again) == weights_hash(ponder)
    mine, theirs = (json.loads((folder / "ponder.json").read_text()) for folder in (tmp_path, SHIPPED / "ponder"))
    assert mine == json.loads(json.dumps(asdict(StoredPonder()))) | theirs  # a field that is newer has its default


def test_the_shipped_pounce_survives_its_folder(pounce: PounceBundle, tmp_path: Path) -> None:
    assert (pounce.is_random, pounce.has_fresh_prefix) == (False, False)
    save_bundle(pounce, tmp_path)
    again = load_bundle(tmp_path)
    assert again.model.config == pounce.model.config
    assert again.statistics == pounce.statistics
    assert again.digest() == pounce.digest()


def test_the_shipped_pair_fits(ponder: Ponder, pounce: PounceBundle) -> None:
    cognition = pounce.model.config.cognition
    assert (cognition.num_carriers, cognition.cognition_size) == (ponder.format.num_carriers, ponder.hidden_size)
    assert cognition.rounds_places


CODE = """
import sys
from dataclasses import asdict
from pathlib import Path

def needed():
    return [name for name in sys.modules if name.startswith("dual_system.models.small_pair")]

import ponder_server.__main__, pounce_server.__main__
assert needed() == [], needed()
from dual_system.models.ponder.checkpoint import load_ponder, save_ponder
from dual_system.models.ponder.configs import tiny_cpu
from dual_system.models.ponder.network import Ponder
from dual_system.models.pounce.checkpoint import load_bundle, random_bundle, save_bundle
from dual_system.models.pounce.configs import tiny_cpu as tiny_pounce

folder, shipped = map(Path, sys.argv[1:])
save_ponder(Ponder.random(tiny_cpu(), seed=0), folder / "ponder")
load_ponder(folder / "ponder")
save_bundle(random_bundle(tiny_pounce(), 0), folder / "pounce")
model = load_bundle(folder / "pounce").model
inputs = model.config.example_inputs(1)
model.cognition_prefix(inputs.cognition, inputs.age_ns)
import ponder_server.engine, pounce_server.engine, dual_system.training.train
assert needed() == [], needed()
load_ponder(shipped / "ponder")
assert needed(), "the shipped folder declares it"
"""


def test_no_program_and_no_other_folder_imports_what_is_the_pairs(tmp_path: Path) -> None:
    arguments = [sys.executable, "-c", CODE, str(tmp_path), str(SHIPPED)]
    done = subprocess.run(arguments, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
