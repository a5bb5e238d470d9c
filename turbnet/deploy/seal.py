"""The seal: a model file carries the SHA-256 of its own bytes.

The metadata entry `turbnet.sha256` is written as 64 zeros, the bytes of the whole file are hashed, and the zeros are
replaced by the digest. Checking goes the same way back, on the bytes alone and before any parser sees them: find the
entry, put the zeros back, hash, compare. The seal tells a damaged or altered file from a whole one; it is no signature.

What is sealed is all there is: a file that keeps weights elsewhere, as ONNX allows, is refused: its seal would say nothing
of them, and reading it would read whatever file it names.
"""

import hashlib
import re

from turbnet.errors import InputError

KEY = "turbnet.sha256"
UNSEALED = "0" * 64

# A StringStringEntryProto: field 1 (tag 0x0a), length, key; field 2 (tag 0x12), length 64, value.
_ENTRY = re.compile(b"\x0a" + bytes([len(KEY)]) + re.escape(KEY.encode()) + rb"\x12\x40([0-9a-f]{64})")

# External data, a field of TensorProto, is a list of such entries of which one has the key "location"; a protobuf string
# comes after its length, 8, which may be written in more bytes than one.
_ELSEWHERE = re.compile(rb"(?:\x08|\x88\x80{0,8}\x00)location")


def seal(data: bytes) -> bytes:
    """Put the digest of `data` in place of the zeros of its `turbnet.sha256` entry."""
    start, end = _value(data)
    if data[start:end] != UNSEALED.encode():
        raise ValueError("sealed already")
    return data[:start] + hashlib.sha256(data).hexdigest().encode() + data[end:]


def verify(data: bytes) -> str:
    """Return the digest that `data` carries, once it is found true.

    Raises:
        InputError: there is no seal, the bytes are not those that were sealed, or they refer to other files.
    """
    start, end = _value(data)
    digest = data[start:end].decode()
    if hashlib.sha256(data[:start] + UNSEALED.encode() + data[end:]).hexdigest() != digest:
        raise InputError("the file is damaged or was changed: its bytes do not match the SHA-256 it carries")
    if _ELSEWHERE.search(data):
        raise InputError("it keeps weights in other files, which is refused; export it as one file")
    return digest


def _value(data: bytes) -> tuple[int, int]:
    entries = [match.span(1) for match in _ENTRY.finditer(data)]
    if len(entries) != 1:
        raise InputError("not a turbnet model: it carries no seal; use a file written by turbnet export")
    return entries[0]
