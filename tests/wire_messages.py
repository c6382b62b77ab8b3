"""Messages to a twin, byte by byte."""

import json
import struct


def framed(content):
    return struct.pack(">I", len(content)) + content


def asked(**message):
    return framed(json.dumps(message).encode())
