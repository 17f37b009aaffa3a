"""Prometheus series of a process: counts of the messages that it sends, and what it knows of itself when it is scraped.

Counting happens where a message is sent and costs a few microseconds; everything else is read by the scrape. Nothing is
kept for it in the schedule or the engines.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass

from prometheus_client import CollectorRegistry, Counter, Gauge, Histogram, disable_created_metrics
from prometheus_client.metrics_core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.process_collector import ProcessCollector
from prometheus_client.registry import Collector

from protocol import messages as m
from protocol.drops import DropReason
from protocol.link import Link

IDENTITY = ("proc", "robot", "model_hash", "build")
"""Labels of every series."""
PREFIX = "ponderpounce_"
_PLAYED = (m.Level.PLAY, m.Level.STALE)
_LATE_S = (1e-4, 2e-4, 5e-4, 1e-3, 2e-3, 5e-3, 1e-2, 2e-2, 5e-2, 1e-1)
_INFER_S = (0.005, 0.01, 0.02, 0.03, 0.05, 0.075, 0.1, 0.15, 0.2, 0.3, 0.5, 0.75, 1.0, 2.0, 5.0)
_AGE_S = (0.1, 0.2, 0.3, 0.5, 0.75, 1.0, 1.5, 2.0, 3.0, 5.0, 10.0)


@dataclass(frozen=True, slots=True, kw_only=True)
class End:
    """One robot's end of the bus in a process, and where to ask what it knows. All functions are called by the scrape.

    Attributes:
        health: state, model and counts, as in the heartbeat; a process without one makes it up when it is asked.
        silent_ns: time since the working loop was last seen at work; 0 while nobody expects it to be (loading).
        limit_ns: silence from which the loop counts as hung.
        num_superseded: requests that a newer one replaced before the model read them.
    """

    link: Link
    health: Callable[[], m.Health]
    silent_ns: Callable[[], int]
    limit_ns: int = 10_000_000_000
    num_superseded: Callable[[], int] = lambda: 0

    @property
    def identity(self) -> tuple[str, str, str, str]:
        """Values of the labels ``IDENTITY``."""
        health = self.health()
        return self.link.proc, self.link.robot, health.model_hash, health.version

    @property
    def hang(self) -> str:
        """Why the working loop counts as hung; "" if it does not."""
        silent_ns = self.silent_ns()
        if silent_ns < self.limit_ns:
            return ""
        silent_s, limit_s = silent_ns / 1e9, self.limit_ns / 1e9
        return f"{self.link.proc} of {self.link.robot}: its loop is silent for {silent_s:.0f} s, limit {limit_s:.0f} s"

    @property
    def unready(self) -> str:
        """Why no episode can be opened here; "" if one can."""
        health = self.health()
        if health.state == m.ServingState.READY:
            return self.hang
        state = f"{health.state.name.lower()} ({health.progress:.0%}) " if health.state else ""
        return f"{self.link.proc} of {self.link.robot} is not ready: {state}{health.detail}".strip()


class Metrics(Collector):
    """Everything that ``/metrics`` prints, for the ends that are watched."""

    def __init__(self) -> None:
        disable_created_metrics()  # a second series beside each counter, which nothing here reads
        self._counted = CollectorRegistry()
        self._ends: dict[tuple[str, str], End] = {}
        self._process = ProcessCollector(registry=None)

        def counter(name: str, text: str, *labels: str) -> Counter:
            return Counter(PREFIX + name, text, (*IDENTITY, *labels), registry=self._counted)

        def histogram(name: str, text: str, buckets: Sequence[float], *labels: str) -> Histogram:
            return Histogram(PREFIX + name, text, (*IDENTITY, *labels), buckets=buckets, registry=self._counted)

        self.ticks = counter("ticks_total", "Ticks of the schedule by rung of the ladder.", "level")
        self.starved = counter("starved_ticks_total", "Ticks without a usable row, once an episode has played one.")
        self.limited = counter("limited_ticks_total", "Ticks whose command was clipped or held by the robot's limits.")
        self.late = histogram("tick_late_seconds", "Time from a tick's deadline to its decision.", _LATE_S)
        self.age = histogram("cognition_age_seconds", "Age of the cognition behind each row that was played.", _AGE_S)
        self.episodes = counter("episodes_total", "Episodes opened.")
        self.asked = counter("asked_total", "Queries and invocations sent to the models.", "kind")
        self.delay = histogram(
            "answer_delay_seconds", "Time from the observation or the invocation to its answer's use.", _INFER_S, "kind"
        )
        self.infer = histogram("infer_seconds", "Computing time of each answer sent.", _INFER_S)
        self.context = Gauge(
            f"{PREFIX}context_tokens", "Tokens in PONDER's context after its last answer.", IDENTITY,
            registry=self._counted,
        )  # fmt: skip
        self.picture_age = Gauge(
            f"{PREFIX}picture_age_seconds", "Age of a camera's picture at the last tick; -1 if none has come.",
            (*IDENTITY, "camera"), registry=self._counted,
        )  # fmt: skip
        self.events = counter("events_total", "Events reported, as in the episode's log.", "severity", "name")

    @property
    def ends(self) -> tuple[End, ...]:
        return tuple(self._ends.values())

    def watch(self, end: End) -> None:
        """Counts what this end of the bus sends from now on, and asks it at every scrape."""
        self._ends = self._ends | {(end.link.proc, end.link.robot): end}  # anew: a scrape may be reading the old one
        end.link.on_sent = _Tally(self, end)

    def collect(self) -> Iterator[Metric]:
        ends = self.ends
        yield from self._counted.collect()
        yield from _facts(ends)
        if ends:
            identity = dict(zip(IDENTITY, ends[0].identity, strict=True))
            for family in self._process.collect():
                family.samples = [sample._replace(labels=identity) for sample in family.samples]
                yield family


def _facts(ends: Sequence[End]) -> Iterator[Metric]:
    """What the ends know, read now."""
    asked = [(end, end.identity, end.health()) for end in ends]

    def gauge(name: str, text: str, value: Callable[[End], float]) -> Metric:
        family = GaugeMetricFamily(PREFIX + name, text, labels=IDENTITY)
        for end, identity, _ in asked:
            family.add_metric(identity, value(end))
        return family

    def counter(name: str, text: str, label: str, values: Callable[[End], Iterable[tuple[str, int]]]) -> Metric:
        family = CounterMetricFamily(PREFIX + name, text, labels=(*IDENTITY, label))
        for end, identity, _ in asked:
            for key, value in values(end):
                family.add_metric((*identity, key), value)
        return family

    yield gauge("ready", "1 if an episode could be opened here.", lambda end: not end.unready)
    yield gauge("episode_open", "1 while an episode runs here.", lambda end: bool(end.link.episode))
    yield gauge("silent_seconds", "Time since the working loop was seen at work.", lambda end: end.silent_ns() / 1e9)
    yield counter(
        "dropped_total", "Messages dropped, by reason.", "reason",
        lambda end: [(reason.value, end.link.dropped[reason]) for reason in DropReason],
    )  # fmt: skip
    yield counter(
        "superseded_total", "Messages and requests that newer ones replaced unread, by queue.", "queue",
        lambda end: (*end.link.num_superseded().items(), ("requests", end.num_superseded())),
    )  # fmt: skip
    untrained = GaugeMetricFamily(f"{PREFIX}untrained", "1 if untrained weights answer.", labels=IDENTITY)
    warm = GaugeMetricFamily(
        f"{PREFIX}warm_infer_seconds", "Computing time of an answer at warm-up.", labels=(*IDENTITY, "quantile")
    )
    answered = CounterMetricFamily(f"{PREFIX}answered_total", "Queries or invocations answered.", labels=IDENTITY)
    for _, identity, health in asked:
        if health.infer_p99_ns:  # a model server, and warm
            untrained.add_metric(identity, health.is_fake)
            warm.add_metric((*identity, "0.5"), health.infer_p50_ns / 1e9)
            warm.add_metric((*identity, "0.99"), health.infer_p99_ns / 1e9)
            answered.add_metric(identity, health.num_answered)
    yield from (untrained, warm, answered)


class _Tally:
    """Counts the messages of one end; called by the thread that sends them."""

    def __init__(self, metrics: Metrics, end: End) -> None:
        self._to = metrics
        self._end = end
        self._has_played = False
        self._cameras: tuple[str, ...] = ()

    def __call__(self, message: object) -> None:
        to = self._to
        match message:
            case m.Tick():
                self._tick(message)
            case m.Query():
                to.asked.labels(*self._end.identity, "query").inc()
            case m.Invocation():
                to.asked.labels(*self._end.identity, "invocation").inc()
            case m.Stamp():
                delay = to.delay.labels(*self._end.identity, message.kind.name.lower())
                delay.observe((message.ready_ns - message.source_ns) / 1e9)
            case m.Cognition():
                to.infer.labels(*self._end.identity).observe(message.infer_ns / 1e9)
                to.context.labels(*self._end.identity).set(message.context_tokens)
            case m.ActionChunk():
                to.infer.labels(*self._end.identity).observe(message.infer_ns / 1e9)
            case m.EpisodeInfo():
                self._has_played, self._cameras = False, message.robot.cameras
                to.episodes.labels(*self._end.identity).inc()
                for level in filter(None, m.Level):  # from 0 on, so that the first tick of a rung is an increase
                    to.ticks.labels(*self._end.identity, level.name.lower())
                to.starved.labels(*self._end.identity)
            case m.Event():
                to.events.labels(*self._end.identity, message.severity.name.lower(), message.name).inc()

    def _tick(self, tick: m.Tick) -> None:
        to, identity = self._to, self._end.identity
        to.ticks.labels(*identity, tick.level.name.lower()).inc()
        if tick.level == m.Level.SKIPPED:
            return
        to.late.labels(*identity).observe(tick.late_ns / 1e9)
        for camera, age_ns in zip(self._cameras, tick.picture_age_ns, strict=False):
            to.picture_age.labels(*identity, camera).set(age_ns / 1e9 if age_ns >= 0 else -1)
        if tick.limits_hit:
            to.limited.labels(*identity).inc()
        if self._has_played and not len(tick.raw_row):  # as ``clock.report.num_starved`` counts from the log
            to.starved.labels(*identity).inc()
        if tick.level in _PLAYED:
            self._has_played = True
            if tick.ref_query is not None:
                to.age.labels(*identity).observe(tick.age_ns / 1e9)
