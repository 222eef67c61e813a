"""Connections to the policy server: who may open one, with which protocol, and how all of them end."""

from __future__ import annotations

import asyncio
import logging
import ssl
from ipaddress import ip_address
from typing import ClassVar
from weakref import WeakSet

from websockets.asyncio.server import Server, ServerConnection

from vla.io.errors import UserError

WEBSOCKET = b"GET "  # how every WebSocket connection begins (RFC 6455, section 4.1)
SENTENCE = b"this is a policy server: connect to it by WebSocket with openpi's protocol\n"
NO_WEBSOCKET = b"HTTP/1.1 405 Method Not Allowed\r\nAllow: GET\r\nConnection: close\r\n" + (
    b"Content-Type: text/plain\r\nContent-Length: %d\r\n\r\n%s" % (len(SENTENCE), SENTENCE)
)

log = logging.getLogger(__name__)


class Connection(ServerConnection):
    """Connection that answers a client of another protocol, which websockets would close silently."""

    _opened: ClassVar[WeakSet[Connection]] = WeakSet()  # from the first packet on, of all servers
    _known = False  # the protocol

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        """Remember an opened connection, which may never say anything."""
        super().connection_made(transport)
        self._opened.add(self)

    def data_received(self, data: bytes) -> None:
        """Receive data; the first packet tells the protocol."""
        if not self._known and not data.startswith(WEBSOCKET[: len(data)]):
            log.warning("refused a client at %s: it does not speak WebSocket", self.remote_address[0])
            self.transport.write(NO_WEBSOCKET)
            self.transport.close()
            return
        self._known = True
        super().data_received(data)

    @classmethod
    def abort_all(cls, server: Server) -> None:
        """Abort all connections to a server."""
        for connection in cls._opened:
            if connection.server is server:
                connection.transport.abort()


def tls(certificate: str, private_key: str | None) -> ssl.SSLContext:
    """Return the TLS context of two PEM files.

    Raises:
        UserError: one is damaged, or they do not belong together.
    """
    context = ssl.SSLContext(ssl.PROTOCOL_TLS_SERVER)
    try:
        context.load_cert_chain(certificate, private_key)
    except ssl.SSLError as error:
        raise UserError(
            f"deploy.certificate={certificate} and deploy.private_key={private_key} are not a certificate and its key "
            f"in PEM format ({error.reason})"
        ) from error
    # Clients with threads, such as openpi's, lose a request in twenty beside the tickets of TLS 1.3.
    context.num_tickets = 0
    return context


def is_loopback(host: str) -> bool:
    """Return whether only this machine can connect to an address."""
    if host == "localhost":
        return True
    try:
        return ip_address(host).is_loopback
    except ValueError:  # a name
        return False
