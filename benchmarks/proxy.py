"""A TCP proxy on loopback that can stall and cut its connections; bytes are neither changed nor reordered."""

from __future__ import annotations

import contextlib
import socket
import threading

from sim_client.launch import free_ports


class Proxy:
    """Forwards connections to ``target``, a port on loopback. Closing it cuts them.

    Attributes:
        endpoint: where it listens, in zenoh's form.
    """

    def __init__(self, target: int) -> None:
        self._target = target
        (port,) = free_ports(1)
        self._listener = socket.create_server(("127.0.0.1", port))
        self.endpoint = f"tcp/127.0.0.1:{port}"
        self._flows = threading.Event()
        self._flows.set()
        self._takes = True
        self._lock = threading.Lock()
        self._open: set[socket.socket] = set()
        self._pumps: list[threading.Thread] = []
        threading.Thread(target=self._accept, daemon=True).start()

    def stall(self) -> None:
        """Holds back all bytes, of new connections as well, until ``flow``."""
        self._flows.clear()

    def cut(self) -> None:
        """Closes all connections and takes no new ones until ``flow``."""
        self._takes = False
        with self._lock:
            for end in self._open:
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)

    def flow(self) -> None:
        self._takes = True
        self._flows.set()

    def close(self) -> None:
        self._listener.close()
        self.cut()
        self._flows.set()
        for thread in self._pumps:
            thread.join(5)

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            far = None
            if self._takes:
                with contextlib.suppress(OSError):  # whom it leads to may be dead
                    far = socket.create_connection(("127.0.0.1", self._target), 3)
            if far is None:
                near.close()
                continue
            with self._lock:
                self._open |= {near, far}
            for source, sink in ((near, far), (far, near)):
                source.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._pumps = [thread for thread in self._pumps if thread.is_alive()]
                self._pumps.append(threading.Thread(target=self._pump, args=(source, sink), daemon=True))
                self._pumps[-1].start()

    def _pump(self, source: socket.socket, sink: socket.socket) -> None:
        with contextlib.suppress(OSError):
            while data := source.recv(1 << 16):
                self._flows.wait()
                sink.sendall(data)
        with self._lock:
            for end in (source, sink):
                with contextlib.suppress(OSError):
                    end.shutdown(socket.SHUT_RDWR)
            if source in self._open:
                self._open.discard(source)
                source.close()
