"""BLF recordings, read by python-can within bounds.

python-can decompresses a container to whatever size it has, and reads objects of length 0 for ever.
Here containers are read and decompressed up to a size, and python-can gets their content.
"""

import re
import struct
import zlib
from collections.abc import Generator

import can

#: Writers use containers of 128 KiB.
LARGEST_CONTAINER_BYTES = 1 << 25
#: Signature, length of the header, version, length of the object, its type.
_OBJECT = struct.Struct("<4sHHLL")
#: Method of compression, length without it.
_CONTAINER = struct.Struct("<H6xL4x")
_KIND_CONTAINER = 10
_STORED, _ZLIB = 0, 2
#: An object that is shorter than its own headers.
_TOO_SHORT = re.compile(rb"LOBJ.{4}[\x00-\x1f]\x00\x00\x00", re.DOTALL)


class BoundedBlfReader(can.BLFReader):
    """Yields messages.

    Raises:
        ValueError: the file is damaged there.
    """

    def __iter__(self) -> Generator[can.Message, None, None]:
        while header := self.file.read(_OBJECT.size):
            signature, _, _, length, kind = _OBJECT.unpack(header)
            if signature != b"LOBJ":
                raise ValueError("no object where one must begin")
            length -= _OBJECT.size
            if not 0 <= length <= LARGEST_CONTAINER_BYTES:
                raise ValueError(f"an object of {length} bytes")
            content = self.file.read(length)
            self.file.read((length + _OBJECT.size) % 4)
            if kind == _KIND_CONTAINER:
                data = _unpacked(content)
                if _TOO_SHORT.search(data):
                    raise ValueError("an object that is shorter than its header")
                yield from self._parse_container(data)
        self.stop()


def _unpacked(content: bytes) -> bytes:
    method, _ = _CONTAINER.unpack_from(content)
    content = content[_CONTAINER.size :]
    if method == _STORED:
        return content
    if method != _ZLIB:
        raise ValueError(f"compressed by the unknown method {method}")
    unpack = zlib.decompressobj()
    data = unpack.decompress(content, LARGEST_CONTAINER_BYTES)
    if unpack.unconsumed_tail:
        raise ValueError(f"a container of more than {LARGEST_CONTAINER_BYTES >> 20} MiB")
    return data
