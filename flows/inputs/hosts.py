"""Hosts that sources may be fetched from: public addresses, and those that `$DG4D_FETCH_ALLOW` adds."""

import ipaddress
import os
import socket
from ipaddress import IPv4Address, IPv6Address

from dg4d_lib.errors import BadInput

ALLOW = "DG4D_FETCH_ALLOW"
UNICAST = ipaddress.IPv6Network("2000::/3")  # global unicast (RFC 4291); all else is reserved, local or multicast
SIX_TO_FOUR = ipaddress.IPv6Network("2002::/16")  # an IPv4 address, possibly private, behind a relay (RFC 3056)
NAT64 = ipaddress.IPv6Network("64:ff9b::/96")  # an IPv4 address behind a translator (RFC 6052)

Address = IPv4Address | IPv6Address


def resolve(host: str, port: int) -> list[str]:
    """Return the addresses of a host, all of which are allowed.

    Args:
        host: name or address, in any notation that the resolver accepts.
        port: of the server.

    Raises:
        BadInput: an address belongs to this machine or a private network and is not in `$DG4D_FETCH_ALLOW`.
        OSError: the name cannot be resolved.
    """
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, proto=socket.IPPROTO_TCP)
    addresses = list(dict.fromkeys(str(sockaddr[0]) for *_, sockaddr in found))
    if not addresses:
        raise OSError("the host has no address")
    names, networks = _allowed()
    if host.lower().rstrip(".") in names:
        return addresses
    for text in addresses:
        address = ipaddress.ip_address(text)
        if not is_public(address) and not any(_embedded_ipv4(address) in network for network in networks):
            raise BadInput(
                f"{host} is on this machine, in a private network or reserved, which is not allowed; give the path of "
                f"a file, or set {ALLOW} of the worker to the host or its network"
            )
    return addresses


def is_public(address: Address) -> bool:
    """Return True for globally reachable addresses; an IPv4 address embedded in IPv6 counts as itself."""
    plain = _embedded_ipv4(address)
    if isinstance(plain, IPv6Address) and (plain not in UNICAST or plain in SIX_TO_FOUR):
        return False
    return plain.is_global and not plain.is_multicast


def _embedded_ipv4(address: Address) -> Address:
    """Return the IPv4 address embedded in an IPv6 address, else the same address."""
    if isinstance(address, IPv6Address):
        if address.ipv4_mapped:
            return address.ipv4_mapped
        if address in NAT64:
            return IPv4Address(int(address) & 0xFFFFFFFF)
    return address


def _allowed() -> tuple[set[str], list[ipaddress.IPv4Network | ipaddress.IPv6Network]]:
    """Parse `$DG4D_FETCH_ALLOW` into host names and networks."""
    names, networks = set(), []
    for text in filter(None, map(str.strip, os.environ.get(ALLOW, "").split(","))):
        try:
            networks.append(ipaddress.ip_network(text, strict=False))
        except ValueError as error:
            if "/" in text or ":" in text:
                raise BadInput(
                    f"{ALLOW} has {text!r}; list host names or networks (10.1.0.0/16), separated by commas"
                ) from error
            names.add(text.lower().rstrip("."))
    return names, networks
