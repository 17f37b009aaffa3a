"""From options to the engine of a policy server."""

from __future__ import annotations

from pounce_server.config import RemoteOptions
from pounce_server.remote.engine import RemoteEngine
from pounce_server.remote.peer import Peer
from protocol import files
from protocol.peers.mapping import PolicyMapping, read_mapping


def build(backend: str, options: RemoteOptions) -> RemoteEngine:
    """Waits for the policy server. Raises OSError, ValueError: see `RemoteEngine`, or an option is missing."""
    if options.url is None or options.mapping is None:
        raise ValueError(f"--backend {backend} needs the policy server's --url and a --mapping file")
    mapping = read_mapping(options.mapping)
    key = files.read_word(options.key_file, "word for --key-file") if options.key_file else ""
    try:
        peer = _peer(backend, options.url, mapping, key)
    except ModuleNotFoundError as error:
        raise ValueError(
            f"--backend {backend} needs {error.name}: pip install 'ponderpounce-server[{_extra(backend)}]'"
        ) from error
    return RemoteEngine(peer, mapping, options.url, answer_s=options.answer_s, start_s=options.start_s)


def _extra(backend: str) -> str:
    return "groot" if backend.startswith("groot") else "policies"


def _peer(backend: str, url: str, mapping: PolicyMapping, key: str) -> Peer:
    """The wire, imported here: each has a package that the others do without."""
    if backend == "openpi":
        from pounce_server.remote.openpi import OpenpiPeer

        return OpenpiPeer(url, mapping, key)
    if backend == "vla-eval":
        from pounce_server.remote.vla_eval import VlaEvalPeer

        if key:
            raise ValueError("--key-file: vla-eval's servers ask for none; leave it out")
        return VlaEvalPeer(url, mapping)
    if backend == "lerobot":
        from pounce_server.remote.lerobot import LerobotPeer

        if key:
            raise ValueError("--key-file: LeRobot's server asks for none; leave it out")
        return LerobotPeer(url, mapping)
    from pounce_server.remote.groot import GrootPeer

    return GrootPeer(url, mapping, is_flat=backend == "groot-n1.5", api_token=key)
