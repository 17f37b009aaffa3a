"""Checks answers of shadows: who sent them was admitted, and each belongs to a request. No motion follows from them."""

from __future__ import annotations

from collections.abc import Iterator
from itertools import chain

from clock.check_findings import Disagreement, compare
from clock.report import ADMITTED_EVENT
from protocol.mcap_log import EpisodeRecord
from protocol.messages import ActionChunk, Cognition


def check_shadows(record: EpisodeRecord) -> Iterator[Disagreement]:
    """Yields what disagrees about cognitions and chunks that were never used."""
    admitted = {
        (event.attributes.get("proc"), event.attributes.get("boot_id"))
        for event in record.events
        if event.name == ADMITTED_EVENT and event.header.proc == "clock"
    }
    answers: chain[Cognition | ActionChunk] = chain(record.shadow_cognitions, record.shadow_chunks)
    for index, answer in enumerate(answers):
        header = answer.header
        if (header.proc, str(header.boot_id)) not in admitted:
            yield from compare(
                "Shadow", index, sender=("one that the clock admitted", f"{header.proc}#{header.boot_id}")
            )
    yield from _check_cognitions(record)
    yield from _check_chunks(record)


def _check_cognitions(record: EpisodeRecord) -> Iterator[Disagreement]:
    asked = {query.query: query for query in record.queries}
    seen: set[tuple[int, int]] = set()
    for index, cognition in enumerate(record.shadow_cognitions):
        query = asked.get(cognition.query)
        if query is None:
            yield from compare("Shadow cognition", index, query=("one that was asked", cognition.query))
            continue
        source = (query.tick, query.source_ns), (cognition.tick, cognition.source_ns)
        yield from compare("Shadow cognition", index, observation=source)
        yield from _once("Shadow cognition", index, cognition, cognition.query, seen)


def _check_chunks(record: EpisodeRecord) -> Iterator[Disagreement]:
    asked = {invocation.invocation: invocation for invocation in record.invocations}
    seen: set[tuple[int, int]] = set()
    for index, chunk in enumerate(record.shadow_chunks):
        invocation = asked.get(chunk.invocation)
        if invocation is None:
            yield from compare("Shadow chunk", index, invocation=("one that was asked", chunk.invocation))
            continue
        yield from compare(
            "Shadow chunk",
            index,
            t_row0=(invocation.tick, chunk.t_row0),
            source_ns=(invocation.now_ns, chunk.source_ns),
            ref_query=(invocation.ref_query, chunk.ref_query),
            age_ns=(invocation.age_ns, chunk.age_ns),
            seed=(invocation.seed, chunk.seed),
        )
        yield from _once("Shadow chunk", index, chunk, chunk.invocation, seen)


def _once(
    message: str, index: int, answer: Cognition | ActionChunk, number: int, seen: set[tuple[int, int]]
) -> Iterator[Disagreement]:
    key = (answer.header.boot_id, number)
    yield from compare(message, index, is_repeated=(False, key in seen))
    seen.add(key)
