"""The address of a site, in the one spelling in which browsers name it."""

from __future__ import annotations

import re
from urllib.parse import urlsplit

from uard import _checks

PORTS = {"http": 80, "https": 443}
_HOST = re.compile(r"[a-z0-9]([a-z0-9._-]*[a-z0-9])?\.?|\[[0-9a-f:.]+\]")


def origin_of(url: str) -> str:
    """Return the origin of a page's address, as a browser writes it.

    Examples:
        >>> origin_of("https://Rate.example.org:443/"), origin_of("http://bücher.example:8080")
        ('https://rate.example.org', 'http://xn--bcher-kva.example:8080')

    Raises:
        InvalidValueError: it is no address of a whole site, or holds a name and a password.
    """
    try:
        parts = urlsplit(url.strip())
        whole = not (parts.path.strip("/") or parts.query or parts.fragment or "@" in parts.netloc)
        scheme, port, host = parts.scheme, parts.port, parts.hostname or ""
        host = f"[{host}]" if ":" in host else host.encode("idna").decode().lower()
    except ValueError:  # no port, or no name that is one
        whole, scheme, port, host = False, "", None, ""
    if not whole or scheme not in PORTS or not _HOST.fullmatch(host):
        allowed = "an address such as https://rate.example.org, without a path, a name and a password"
        raise _checks.InvalidValueError("public_url", url, allowed)
    return f"{scheme}://{host}" + ("" if port in (None, PORTS[scheme]) else f":{port}")
