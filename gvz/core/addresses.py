"""What is asked of an address before anything listens or connects there."""

import ipaddress
import socket

from gvz.core.errors import ConfigError


def resolve(host: str, where: str) -> list[str]:
    """The IP addresses of a host, at least one, in the order in which this machine prefers them.

    Raises:
        ConfigError: no machine has this name; the message begins with `where`.
    """
    try:
        return [str(found[4][0]) for found in socket.getaddrinfo(host, None, type=socket.SOCK_STREAM)]
    except OSError as error:
        raise ConfigError(f"{where}: no machine has the name {host!r} ({error.strerror or error})") from error


def require_private(ip: str, where: str, advice: str) -> None:
    """Raises ConfigError for an address that the whole Internet may reach; `advice` ends the message."""
    address = ipaddress.ip_address(ip)
    if address.is_global:
        raise ConfigError(f"{where}: {ip} is a public address; {advice}")
    if address.is_unspecified:
        raise ConfigError(f"{where}: {ip} stands for all addresses of a machine, public ones too; {advice}")
