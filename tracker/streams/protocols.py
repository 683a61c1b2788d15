"""Every protocol that poses leave by, told from the tables that the encoders are made of: the page docs/protocols.md."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from .addresses import (
    ADDRESSES,
    EXTRA_ADDRESSES,
    MAX_BLOB_BYTES,
    MAX_DATAGRAM_BYTES,
    Address,
    address_table,
    find_address,
)
from .vmc import VMC_ADDRESSES
from .vrchat import VRCHAT_ADDRESSES

PATIENT_CLIENT_BYTES = 8192
"""What the authors' programs read of a datagram."""


def known_address(path: str) -> Address | None:
    """The row of any of our OSC protocols that a received path belongs to."""
    return find_address(path) or next(
        (row for row in VMC_ADDRESSES + VRCHAT_ADDRESSES if row.matches(path)), None
    )


def protocols_page() -> str:
    """The whole of docs/protocols.md."""
    from . import announcing, lsl, oscquery
    from .page import protocol as page_protocol
    from .targets import KINDS

    targets = _table(
        ("target", "what", "poses a second", "names", "options", "needs"),
        (
            (
                f"`{kind.form}`",
                kind.words,
                f"{kind.rate_hz:g}" if kind.rate_hz else "every frame",
                kind.preset or "-",
                ", ".join(f"`{name}`" for name in kind.options) or "-",
                f"extra `{kind.extra}`" if kind.extra else "-",
            )
            for kind in KINDS
        ),
    )
    options = _table(
        ("option", "meaning"),
        ((f"`{name}`", words) for name, words in {n: w for k in KINDS for n, w in k.options.items()}.items()),
    )
    attributes = ", ".join(f"`{name}`" for name in oscquery.ATTRIBUTES)
    return f"""# All protocols

This page is made by `tonguetrack monitor --protocols > docs/protocols.md` from the tables that the encoders use.
[streams.md](streams.md) says how to use them, [receivers](receivers/README.md) has programs that receive.

## Targets

{targets}

{options}

## Sizes

| what | at most |
|---|---|
| a datagram of our OSC, VMC or VRChat | {MAX_DATAGRAM_BYTES} bytes, so that no network cuts it into pieces; VMC asks for 1500 |
| a blob of the mesh | {MAX_BLOB_BYTES} bytes |
| a datagram of JSON | as long as the model needs: 400 bytes for 9 weights; the authors' programs read {PATIENT_CLIENT_BYTES} |

All datagrams go by UDP, from a socket that is not connected: an absent receiver changes nothing.

## Our own OSC

[osc.md](osc.md) explains it. {len(ADDRESSES)} addresses always, {len(EXTRA_ADDRESSES)} more with `send=`:

{address_table((*ADDRESSES, *EXTRA_ADDRESSES))}

## VMC protocol

As an Assistant (https://protocol.vmc.info): to port 39540 of a Performer unless told otherwise, which passes it on to the
Marionette that draws; port 39539 is the Marionette's and not for us. Each pose is one bundle; where a preset has too many
names for one datagram, several, of which only the last applies.

{address_table(VMC_ADDRESSES)}

## VRChat and VRCFaceTracking

Avatar parameters (https://docs.vrchat.com/docs/osc-avatar-parameters), by the names of https://docs.vrcft.io, to port
9000. One value a message. Avatars whose parameters are packed into several bools (`TongueX1`, `TongueX2`, ...) are not
driven.

{address_table(VRCHAT_ADDRESSES)}

## Names: the presets

A value is a weighted sum of our shapes ([shapes.md](shapes.md)), cut to 0..1, or to -1..1 for an axis with two ends; VMC
gets no axes.

{_presets()}

## Lab Streaming Layer

Two outlets (https://labstreaminglayer.readthedocs.io), both of 64-bit floats, with the frame's arrival at the tracker's
computer as the stamp of both. They are announced with the device's rate; as irregular with `rate=`. The source id is
`tonguetrack/HOST/NAME`, and stays.

`NAME`, type {lsl.COILS_TYPE}, with the meta-data of https://github.com/sccn/xdf/wiki/MoCap-Meta-Data; {lsl.COORDINATES}; NaN
while a coil is missing. For each coil:

{_channels(lsl.coil_channels(("ROLE",)))}

`NAME{lsl.POSE_SUFFIX}`, type {lsl.POSE_TYPE}, for K = 2 and one speaker weight:

{_channels(lsl.pose_channels(2, 1))}

## The JSON of the authors' live server

One map in a datagram, and a line end:

| key | value |
|---|---|
| `phonemeWeights` | K raw weights of the pose |
| `speakerWeights` | m raw weights of the speaker |
| `timeStamp` | the device's time in s |

## OSCQuery

HTTP (https://github.com/Vidvox/OSCQueryProposal), by default at {oscquery.DEFAULT_ADDRESS}. `GET /` is the whole tree of the
OSC addresses above and of those that `tonguetrack live` obeys; `GET /tongue/pose` a part of it; `GET
/tongue/pose?VALUE` one attribute; `GET /?HOST_INFO` who answers, and where control messages are taken. Attributes:
{attributes}. 404: no such address; 204: it has no such attribute; 400: there is no such attribute.

ACCESS is {oscquery.READ_ONLY} for what is sent and can be read, {oscquery.WRITE_ONLY} for control messages, {oscquery.NOT_KEPT} for
containers and for what has no value now. `GET {oscquery.MODEL_PATH}` is the model of this speaker as binary glTF, its
directions re-based to 0..1. At most {oscquery.MOST_CLIENTS} clients at a time.

With the extra `discovery` it is announced by mDNS, as `{announcing.HTTP_TYPE}` and, where control messages are taken, as
`{announcing.OSC_TYPE}`; on this computer only, unless the address is another's.

## The page

`--web` serves a page, and what it gets over its WebSocket is for anybody who writes one; [page.md](page.md) shows it.

```text
{(page_protocol.__doc__ or "").strip()}
```
"""


def _presets() -> str:
    from .presets import load_preset, preset_names

    parts = []
    for preset in map(load_preset, preset_names()):
        lines = [f"### `{preset.name}`: {preset.title}", "", f"Source: {preset.source}", ""]
        if preset.every_shape:
            lines.append(
                "Every shape of ours under its own name, and `pose_0` to `pose_<K-1>`, the model's own directions."
            )
        else:
            rows = [
                (
                    f"`{t.name}`",
                    "-1..1" if t.low < 0 else "0..1",
                    _sum(t.terms),
                )
                for t in preset.targets
            ]
            rows += [(f"`{name}`", "not sent", why) for name, why in preset.undriven.items()]
            lines.append(_table(("name", "range", "made of"), rows))
        parts.append("\n".join(lines))
    return "\n\n".join(parts)


def _sum(terms: Sequence[tuple[str, float]]) -> str:
    """ "flat - 0.5 narrow"."""
    words = " ".join(
        f"{'-' if weight < 0 else '+'} {'' if abs(weight) == 1.0 else f'{abs(weight):g} '}{shape}"
        for shape, weight in terms
    )
    return words.removeprefix("+ ")


def _channels(channels: Iterable[object]) -> str:
    keys = ("label", "type", "unit", "marker", "object")
    return _table(keys, ([getattr(channel, key) or "-" for key in keys] for channel in channels))


def _table(head: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    lines = [f"| {' | '.join(cells)} |" for cells in (head, *rows)]
    return "\n".join([lines[0], "|---" * len(head) + "|", *lines[1:]])
