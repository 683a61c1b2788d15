"""Prints what the tongue does: python receive.py [PORT]. Needs nothing but Python."""

import socket
import struct
import sys


def messages(data):  # of one OSC datagram: a bundle, or a message itself
    if data.startswith(b"#bundle"):
        at = 16
        while at < len(data):
            size = int.from_bytes(data[at : at + 4], "big")
            yield from messages(data[at + 4 : at + 4 + size])
            at += 4 + size
    else:
        (address, at), values = text(data, 0), []
        tags, at = text(data, at)
        for tag in tags[1:]:  # s, i or f
            value, at = text(data, at) if tag == "s" else (*struct.unpack_from(f">{tag}", data, at), at + 4)
            values.append(value)
        yield address, values


def text(data, at):  # and where it ends: it is filled to four bytes with zeros
    end = data.index(b"\0", at)
    return data[at:end].decode(), end + 4 - end % 4


listener = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
listener.bind(("127.0.0.1", int(sys.argv[1]) if len(sys.argv) > 1 else 9000))
print("listening", flush=True)
while True:
    for address, values in messages(listener.recv(2048)):
        if address in ("/tongue/info", "/tongue/sigma"):
            print(address, *values, flush=True)
