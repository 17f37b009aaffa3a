"""What a simulated robot sees, in the protocol's terms."""

from __future__ import annotations

from dual_system.models.ponder.demo_sampling import DemoSampling
from dual_system.tasks.engine import Status
from dual_system.tasks.environment import Snapshot
from protocol import images
from protocol.messages import DemoFrame, Image, ImageCodec, Observation, TaskStatus
from sim_client.panda_robot import CONTROL_HZ
from sim_client.worlds import World

_STATUS = {
    Status.ONGOING: TaskStatus.ONGOING,
    Status.SUCCESS: TaskStatus.SUCCESS,
    Status.FAIL: TaskStatus.FAIL,
    Status.TIMEOUT: TaskStatus.TIMEOUT,
}


def demonstration(environment: World, codec: ImageCodec, sampling: DemoSampling) -> tuple[DemoFrame, ...]:
    """The conditioning video as PONDER reads it, before the first query; () for tasks without one."""
    rate_hz = CONTROL_HZ if sampling.to_its_end else sampling.hz
    video = environment.demonstration(rate_hz, look_hz=sampling.hz)
    return tuple(DemoFrame(images=_pictures(each, codec)) for each in video if each.frames or not sampling.to_its_end)


def observation(snapshot: Snapshot, tick: int, source_ns: int, codec: ImageCodec) -> Observation:
    """The robot's observation at ``tick``; without images if nothing was rendered."""
    return Observation(
        tick=tick,
        source_ns=source_ns,
        proprio=snapshot.state,
        images=_pictures(snapshot, codec),
        status=_STATUS[snapshot.status],
        reason=snapshot.reason,
    )


def _pictures(snapshot: Snapshot, codec: ImageCodec) -> tuple[Image, ...]:
    return images.pack(dict(snapshot.frames), codec)


def status_of(snapshot: Snapshot) -> TaskStatus:
    return _STATUS[snapshot.status]
