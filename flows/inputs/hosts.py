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
    """Return the addresses of a host, every one of which may be connected to.

    Args:
        host: a name or an address, in any notation that the resolver knows.
        port: of the server.

    Raises:
        BadInput: an address is of this machine or of a private network, and `$DG4D_FETCH_ALLOW` does not have it.
        OSError: the name cannot be resolved.
    """
    found = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM, proto=socket.IPPROTO_TCP)
    addresses = list(dict.fromkeys(str(place[0]) for *_, place in found))
    if not addresses:
        raise OSError("the host has no address")
    names, networks = _allowed()
    if host.lower().rstrip(".") in names:
        return addresses
    for text in addresses:
        address = ipaddress.ip_address(text)
        if not is_public(address) and not any(_plain(address) in network for network in networks):
            raise BadInput(
                f"{host} is on this machine, in a private network or reserved, and nothing is fetched from there; give "
                f"the path of a file, or set {ALLOW} of the worker to the host or its network"
            )
    return addresses


def is_public(address: Address) -> bool:
    """Return whether anybody on the internet can have this address; an IPv4 address inside one of IPv6 counts."""
    plain = _plain(address)
    if isinstance(plain, IPv6Address) and (plain not in UNICAST or plain in SIX_TO_FOUR):
        return False
    return plain.is_global and not plain.is_multicast


def _plain(address: Address) -> Address:
    """Return the IPv4 address that an IPv6 address stands for, else the same."""
    if isinstance(address, IPv6Address):
        if address.ipv4_mapped:
            return address.ipv4_mapped
        if address in NAT64:
            return IPv4Address(int(address) & 0xFFFFFFFF)
    return address


def _allowed() -> tuple[set[str], list[ipaddress.IPv4Network | ipaddress.IPv6Network]]:
    """Return the host names and the networks of `$DG4D_FETCH_ALLOW`."""
    names, networks = set(), []
    for entry in os.environ.get(ALLOW, "").split(","):
        text = entry.strip()
        try:
            networks += [ipaddress.ip_network(text, strict=False)] if text else []
        except ValueError as error:
            if "/" in text or ":" in text:
                raise BadInput(
                    f"{ALLOW} has {text!r}; list host names or networks (10.1.0.0/16), separated by commas"
                ) from error
            names.add(text.lower().rstrip("."))
    return names, networks
