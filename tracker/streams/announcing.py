"""Announces an OSCQuery server in the local network, or on this computer alone, by mDNS (extra `discovery`).

Service types: `_oscjson._tcp` for the HTTP server and `_osc._udp` for the OSC port beside it, as in the OSCQuery proposal
(https://github.com/Vidvox/OSCQueryProposal). To announce takes seconds, for mDNS first asks whether a name is taken.
"""

from __future__ import annotations

import os
import threading
from collections.abc import Callable

HTTP_TYPE, OSC_TYPE = "_oscjson._tcp.local.", "_osc._udp.local."
EVERYWHERE = ("0.0.0.0", "::")
OWN_NAME = f"tonguetrack-{os.getpid()}.local."
"""Of this computer, as those know it who have found an announced server."""
CLOSE_S = 2.0


class Announcement:
    """Announced from a thread of its own until closed. Whatever goes wrong is said once, and nothing else happens.

    name: as people see it; where it is taken, a number is added. host: the numeric address that the server is bound to:
    only its own network interface hears of it. osc_port: 0 = there is none. announced: set once everybody can find it.
    """

    def __init__(
        self,
        name: str,
        host: str,
        http_port: int,
        osc_port: int,
        said: Callable[[str], None] = lambda text: None,
    ) -> None:
        self.announced = threading.Event()
        self._name, self._host, self._http_port, self._osc_port = name, host, http_port, osc_port
        self._said = said
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._run, name="announcing", daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Takes the announcement back, and waits for it, but not for ever."""
        self._over.set()
        self._thread.join(CLOSE_S)

    def _run(self) -> None:
        try:
            import zeroconf
        except ImportError:
            self._said(
                "OSCQuery is not announced: that needs the extra 'discovery': pip install 'tonguetrack[discovery]'"
            )
            return
        try:
            everywhere = self._host in EVERYWHERE
            addresses = zeroconf.get_all_addresses() if everywhere else [self._host]
            interfaces = zeroconf.InterfaceChoice.All if everywhere else [self._host]
            with zeroconf.Zeroconf(interfaces=interfaces) as network:
                for kind, port in ((HTTP_TYPE, self._http_port), (OSC_TYPE, self._osc_port)):
                    if port and not self._over.is_set():
                        service = zeroconf.ServiceInfo(
                            kind,
                            f"{self._name}.{kind}",
                            port,
                            server=OWN_NAME,
                            parsed_addresses=addresses,
                        )
                        network.register_service(service, allow_name_change=True)
                self.announced.set()
                self._over.wait()
                network.unregister_all_services()
        except Exception as reason:  # noqa: BLE001
            # No network, no multicast, a name that mDNS does not bear: the stream itself goes on.
            self._said(f"OSCQuery is not announced: {reason or type(reason).__name__}")
