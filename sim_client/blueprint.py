"""The layout of a replayed episode: cameras and words above, what was commanded in the middle, who did what below.

The log's protobufs arrive in rerun as one struct component per message; mappings pick the fields to plot. That mapping
API still moves (rerun issue 12600), so rerun is pinned and a screenshot test looks at the result.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from rerun.blueprint.encodings import ComponentSourceKind, VisualizerComponentMapping

from protocol.messages import EpisodeInfo

TIMELINE = "message_log_time"  # episode time, by the log's time rule
_TICK = "ponderpounce.v1.Tick:message"
_PHASE = "ponderpounce.v1.Phase:message"
_COLORS = np.array(  # Okabe and Ito's, apart for every kind of eye; rerun's own repeat after a few series
    [0xE69F00FF, 0x56B4E9FF, 0x009E73FF, 0xF0E442FF, 0x0072B2FF, 0xD55E00FF, 0xCC79A7FF, 0xBBBBBBFF], np.uint32
)
_LANES = ("/s2/phase", "/s1/phase", "/clock/phase", "/sim/phase")


def episode_blueprint(info: EpisodeInfo) -> rrb.Blueprint:
    """The layout for one episode's cameras and dimensions."""
    command_names = [*(f"joint {k}" for k in range(1, info.robot.action_dim)), "gripper"]
    state_names = [*(f"joint {k}" for k in range(1, info.robot.num_proprio)), "finger"]
    cameras = [rrb.Spatial2DView(origin=f"/camera/{camera}", name=camera) for camera in info.robot.cameras]
    return rrb.Blueprint(
        rrb.Vertical(
            rrb.Horizontal(
                *cameras,
                rrb.TextLogView(origin="/log", name="subgoals and events"),
                column_shares=[*([1.0] * len(cameras)), 1.6],
            ),
            rrb.Horizontal(
                _plot("action [rad]", ".action[]", command_names),
                _plot("state [rad]", ".state[]", state_names),
                rrb.Vertical(
                    _plot("cognition age [ms]", ".age_ms", ["age of the cognition behind the row"]),
                    _plot("lateness [ms]", ".late_ms", ["row decided after its deadline"]),
                ),
            ),
            rrb.StateTimelineView(
                origin="/",
                contents=list(_LANES),
                name="phases (s2: PONDER, s1: POUNCE)",
                overrides={lane: [_state()] for lane in _LANES},
            ),
            row_shares=[3.0, 2.6, 1.5],
        ),
        rrb.TimePanel(state="collapsed", timeline=TIMELINE),
        rrb.BlueprintPanel(state="hidden"),
        rrb.SelectionPanel(state="hidden"),
        auto_views=False,
        auto_layout=False,
    )


def _plot(title: str, selector: str, names: Sequence[str]) -> rrb.TimeSeriesView:
    """Series of one field of every tick; ``selector`` as in jq."""
    colors = np.resize(_COLORS, len(names))
    series = rr.SeriesLines(names=list(names), colors=colors)
    lines = series.visualizer(mappings=[_from("Scalars:scalars", _TICK, selector)])
    return rrb.TimeSeriesView(origin="/", contents=["/tick"], name=title, overrides={"/tick": [lines]})


def _state() -> rrb.Visualizer:
    return rr.StateChange.from_fields().visualizer(mappings=[_from("StateChange:state", _PHASE, ".state")])


def _from(target: str, component: str, selector: str) -> VisualizerComponentMapping:
    return VisualizerComponentMapping(
        target=target,
        source_kind=ComponentSourceKind.SourceComponent,
        source_component=component,
        selector=selector,
    )
