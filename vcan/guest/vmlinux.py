#!/usr/bin/env python3
"""Unpacks the ELF kernel out of a bzImage.

usage: vmlinux.py VMLINUZ OUTPUT

The offsets are those of the Linux x86 boot protocol (Documentation/arch/x86/boot.rst). Exits 1
with the reason when the payload is packed with something Python's library has not.
"""

import lzma
import struct
import sys
import zlib

HEADER_MAGIC_AT = 0x202
SETUP_SECTORS_AT = 0x1F1
PAYLOAD_OFFSET_AT = 0x248


def unpack(image: bytes) -> bytes:
    if image[HEADER_MAGIC_AT : HEADER_MAGIC_AT + 4] != b"HdrS":
        raise ValueError("not a bzImage")
    # 0 means 4, for boot loaders of the nineties; one more sector is the boot sector.
    protected_mode = ((image[SETUP_SECTORS_AT] or 4) + 1) * 512
    offset, length = struct.unpack_from("<II", image, PAYLOAD_OFFSET_AT)
    payload = image[protected_mode + offset : protected_mode + offset + length]
    # Four bytes of size follow the packed data: decompressors, not decompress().
    if payload.startswith(b"\xfd7zXZ\0"):
        kernel = lzma.LZMADecompressor(lzma.FORMAT_XZ).decompress(payload)
    elif payload.startswith(b"\x1f\x8b"):
        kernel = zlib.decompressobj(wbits=31).decompress(payload)
    else:
        raise ValueError(f"unknown packing, it starts with {payload[:4].hex()}")
    if not kernel.startswith(b"\x7fELF"):
        raise ValueError("the payload is not an ELF kernel")
    return kernel


def main() -> None:
    source, target = sys.argv[1:]
    with open(source, "rb") as file:
        image = file.read()
    try:
        kernel = unpack(image)
    except (ValueError, lzma.LZMAError, zlib.error) as error:
        sys.exit(f"{source}: {error}")
    with open(target, "wb") as file:
        file.write(kernel)


if __name__ == "__main__":
    main()
