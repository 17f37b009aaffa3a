"""One of RoboMME's own two evaluators, as it stands, on the published ManiSkill.

    python evaluator.py challenge --port 8001 --num_episodes 1      # challenge_interface/scripts/phase1_eval.py
    python evaluator.py policy --port 8011                          # examples/robomme/eval.py

The arguments are the evaluator's. The challenge's has none for the tasks: the variable TASKS names those to play.
"""

from __future__ import annotations

import importlib.util
import os
import runpy
import sys
from pathlib import Path
from types import ModuleType

import robomme_cpu

_UNUSED = {  # by module: what the policy's evaluator imports from it for subgoal predictors, which are not asked for
    "google.generativeai": (),
    "swift.llm": ("PtEngine", "InferRequest", "RequestConfig"),
}


def main(evaluator: str, arguments: list[str]) -> None:
    source = Path(os.environ["ROBOMME"])
    robomme_cpu.complete()
    import robomme.robomme_env  # noqa: F401 - registers the environments
    from robomme.env_record_wrapper import BenchmarkEnvBuilder

    if tasks := os.environ.get("TASKS"):
        BenchmarkEnvBuilder.get_task_list = classmethod(lambda cls: tasks.split())
    sys.argv = [evaluator, *arguments]
    if evaluator == "challenge":
        runpy.run_module("challenge_interface.scripts.phase1_eval", run_name="__main__")
        return
    for name, contents in _UNUSED.items():
        module = ModuleType(name)
        for each in contents:
            setattr(module, each, None)
        package = name.partition(".")[0]
        if importlib.util.find_spec(package) is None:
            sys.modules[package] = ModuleType(package)
        sys.modules[name] = module
    folder = source / "robomme_policy_learning" / "examples" / "robomme"
    sys.path.insert(0, str(folder))
    runpy.run_path(str(folder / "eval.py"), run_name="__main__")


if __name__ == "__main__":
    if sys.argv[1:2] not in (["challenge"], ["policy"]):
        sys.exit(__doc__)
    main(sys.argv[1], sys.argv[2:])
