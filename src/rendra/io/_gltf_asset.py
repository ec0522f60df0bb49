"""A glTF 2.0 asset and its bytes: the two containers, buffers, views, accessors and images.

Nothing is allocated before the bytes are known to be there. Indices and offsets count from 0.
"""

import base64
import binascii
import struct
import warnings
from typing import Any, NoReturn
from urllib.parse import unquote, unquote_to_bytes

import numpy as np
import numpy.typing as npt

from rendra.io._gltf_json import Item, parse_json
from rendra.io._source import PathManager, Source, neighbour, read_neighbour
from rendra.io.errors import MeshFormatError

Values = npt.NDArray[Any]
Floats = npt.NDArray[np.float32]

FLOAT, UINT, USHORT, UBYTE, SHORT, BYTE = 5126, 5125, 5123, 5121, 5122, 5120
_KINDS = {BYTE: "i1", UBYTE: "u1", SHORT: "<i2", USHORT: "<u2", UINT: "<u4", FLOAT: "<f4"}
_WIDTHS = {"SCALAR": 1, "VEC2": 2, "VEC3": 3, "VEC4": 4}
_TYPES = (*_WIDTHS, "MAT2", "MAT3", "MAT4")

_MAGIC = b"glTF"
_JSON_CHUNK, _BINARY_CHUNK = 0x4E4F534A, 0x004E4942
# What may be required of a reader that wants shape and base colour alone.
_UNDERSTOOD = (
    "KHR_mesh_quantization", "KHR_texture_transform", "EXT_texture_webp", "KHR_lights_punctual", "KHR_xmp_json_ld",
)  # fmt: skip


class Asset:
    """One glTF file.

    Args:
        source: the bytes of a .glb or .gltf file; which of them is seen from the first bytes.
        path_manager: interprets paths where given.
        allow_outside: let buffers and images lie outside the file's folder.

    Attributes:
        root: the whole document.
        accessors, images, materials, meshes, nodes, samplers, textures: its lists.

    Raises:
        MeshFormatError: malformed, of another version, or in need of an extension that is not understood.
    """

    def __init__(self, source: Source, path_manager: PathManager | None, allow_outside: bool) -> None:
        self._source, self._path_manager, self._allow_outside = source, path_manager, allow_outside
        document, self._binary = _split(source)
        self.root = Item(document, "", source.name)
        self._demand_understood()
        self._buffers, self._views = self.root.items("buffers"), self.root.items("bufferViews")
        self.accessors, self.images = self.root.items("accessors"), self.root.items("images")
        self.materials, self.meshes = self.root.items("materials"), self.root.items("meshes")
        self.nodes, self.samplers = self.root.items("nodes"), self.root.items("samplers")
        self.textures = self.root.items("textures")
        self._held: dict[int | str, bytes] = {}
        self._read: dict[int, Values] = {}

    def _demand_understood(self) -> None:
        asset = self.root.item("asset")
        if asset is None:
            self.root.fail("asset", "is missing", expected='an object with "version": "2.0"')
        version = asset.text("version")
        if not version.startswith("2."):
            asset.fail("version", "is not supported", version, "2.0")
        for name in self.root.texts("extensionsRequired"):
            if name not in _UNDERSTOOD and not name.startswith("KHR_materials_"):
                compressed = "; save the file without compression" if "compression" in name else ""
                self.root.fail(
                    "extensionsRequired", f"the file needs an extension that is not supported{compressed}", name
                )
        self.quantized = "KHR_mesh_quantization" in self.root.texts("extensionsUsed")

    def size(self) -> int:
        """Bytes of the file and of all its buffers."""
        return len(self._source.data) + sum(
            len(self._buffer(i)) for i, each in enumerate(self._buffers) if "uri" in each
        )

    def rows(self, index: int) -> int:
        """How many rows an accessor says it has, before anything is read."""
        return self.accessors[index].integer("count", low=1)

    def accessor(self, index: int, components: tuple[int, ...], widths: tuple[str, ...]) -> Values:
        """(count, width) numbers of the file's own type.

        Args:
            index: of the accessor.
            components: component types that are allowed.
            widths: types that are allowed: "SCALAR", "VEC2", ...

        Raises:
            MeshFormatError: another type, or bytes outside of the buffer.
        """
        item = self.accessors[index]
        component, width = item.integer("componentType"), item.text("type")
        if component not in components:
            item.fail("componentType", "is not allowed here", component, " or ".join(map(str, components)))
        if width not in widths:
            item.fail("type", "is not allowed here", width, " or ".join(widths))
        if index not in self._read:
            self._read[index] = self._read_accessor(item, _KINDS[component], _WIDTHS[width])
        return self._read[index]

    def _read_accessor(self, item: Item, kind: str, width: int) -> Values:
        if "sparse" in item:
            item.fail("sparse", "sparse accessors are not supported")
        number = item.index("bufferView", len(self._views), "bufferViews")
        if number is None:
            item.fail("bufferView", "is missing, and zeros or compressed data are not supported")
        view, data = self._views[number], self._view(number)
        count, offset = item.integer("count", low=1), item.integer("byteOffset", 0)
        size = np.dtype(kind).itemsize * width
        stride = view.integer("byteStride", size, 1, 252)
        if stride < size:
            view.fail("byteStride", f"is less than one element of {item.where}", stride, f"{size} or more")
        if offset + stride * (count - 1) + size > len(data):
            item.fail(
                "count",
                "the accessor runs past the end of its bufferView",
                f"{count} elements, {stride} bytes apart, from byte {offset}",
                f"at most {len(data)} bytes",
            )
        strides = (stride, size // width)
        return np.ndarray((count, width), kind, data, offset, strides).astype(kind[-2:])

    def floats(self, index: int, components: tuple[int, ...], widths: tuple[str, ...], scaled: bool) -> Floats:
        """(count, width) finite single precision numbers.

        Args:
            index, components, widths: as for `accessor`.
            scaled: integers are fractions, also where the file forgets to say so.

        Raises:
            MeshFormatError: as `accessor`, or a number that is not finite.
        """
        item = self.accessors[index]
        values = self.accessor(index, components, widths)
        if values.dtype.kind == "f":
            bad = ~np.isfinite(values).all(axis=1)
            if bad.any():
                row = int(bad.argmax())
                item.fail(None, f"element {row} is not finite", values[row].tolist(), "finite numbers")
            return values.astype(np.float32)
        if scaled or item.flag("normalized"):
            return np.maximum(values / np.iinfo(values.dtype).max, -1.0).astype(np.float32)
        return values.astype(np.float32)

    def _view(self, index: int) -> memoryview:
        """The bytes of one bufferView."""
        view = self._views[index]
        number = view.index("buffer", len(self._buffers), "buffers")
        if number is None:
            view.fail("buffer", "is missing")
        data = self._buffer(number)
        offset, length = view.integer("byteOffset", 0), view.integer("byteLength", low=1)
        if offset + length > len(data):
            view.fail(
                None, "lies outside of its buffer", f"bytes {offset} to {offset + length}", f"at most {len(data)}"
            )
        return memoryview(data)[offset : offset + length]

    def _buffer(self, index: int) -> memoryview:
        """The bytes of one buffer, as many as it declares."""
        buffer = self._buffers[index]
        length = buffer.integer("byteLength", low=1)
        if "uri" in buffer:
            data = self._fetch(buffer)
            if data is None:
                buffer.fail("uri", "there is no such file", buffer.text("uri"))
        elif index == 0 and self._binary is not None:
            data = self._binary
        else:
            buffer.fail("uri", "is missing, and there is no binary chunk to take its place")
        if len(data) < length:
            buffer.fail("byteLength", "the data is shorter than its declaration", length, f"at most {len(data)}")
        return memoryview(data)[:length]

    def image(self, index: int) -> tuple[bytes, str] | None:
        """The encoded bytes of one image and what errors call it; None where its file does not exist."""
        image = self.images[index]
        if "uri" in image:
            uri = image.text("uri")
            data = self._fetch(image)
            name = image.where if uri.startswith("data:") else uri[:200]
            return None if data is None else (data, f"{self._source.name}, {name}")
        number = image.index("bufferView", len(self._views), "bufferViews")
        if number is None:
            image.fail(None, "has neither uri nor bufferView")
        return bytes(self._view(number)), f"{self._source.name}, {image.where}"

    def _fetch(self, item: Item) -> bytes | None:
        """What the field "uri" stands for, read once; None where there is no such file."""
        uri = item.text("uri")
        if uri in self._held:
            return self._held[uri]
        if uri[:5].lower() == "data:":
            data: bytes | None = _decode_data_uri(item, uri)
        else:
            path = neighbour(
                self._source.folder,
                unquote(uri),
                file=f"{self._source.name}, {item.where}",
                line=None,
                path_manager=self._path_manager,
                allow_outside=self._allow_outside,
            )
            data = read_neighbour(path, self._path_manager)
        if data is not None:
            self._held[uri] = data
        return data


def _decode_data_uri(item: Item, uri: str) -> bytes:
    head, comma, body = uri.partition(",")
    if not comma:
        item.fail("uri", "the data URI has no comma", uri[:40], "data:<type>;base64,<data>")
    if not head.lower().endswith(";base64"):
        return unquote_to_bytes(body)
    try:
        return base64.b64decode(unquote(body), validate=True)
    except (binascii.Error, ValueError) as error:
        item.fail("uri", f"the data URI is no base64 ({error})", uri[:40])


def _split(source: Source) -> tuple[dict, bytes | None]:
    """The JSON document and the binary chunk of a file of either kind."""
    data = source.data
    if data[:4] != _MAGIC:
        if data.lstrip()[:1] != b"{":
            shown = data[:16].decode("latin-1")
            raise MeshFormatError("no glTF file", source.name, found=shown, expected="'glTF', or a JSON object")
        return parse_json(data, source.name, 0), None
    if len(data) < 12:
        _fail_byte(source, len(data), "the file ends within its header", f"{len(data)} bytes", "12 bytes")
    version, length = struct.unpack_from("<II", data, 4)
    if version != 2:
        _fail_byte(source, 4, "the container's version is not supported", str(version), "2")
    if length > len(data) or length < 12:
        _fail_byte(source, 8, "the length in the header is not the file's", str(length), str(len(data)))
    if length < len(data):
        warnings.warn(f"{source.name}: {len(data) - length} bytes behind the end are ignored", stacklevel=6)
    return _read_chunks(source, length)


def _read_chunks(source: Source, end: int) -> tuple[dict, bytes | None]:
    document: dict | None = None
    binary: bytes | None = None
    position, number = 12, 0
    while position < end:
        if position + 8 > end:
            _fail_byte(source, position, "the file ends within a chunk's header")
        length, kind = struct.unpack_from("<II", source.data, position)
        start = position + 8
        if start + length > end:
            _fail_byte(source, position, "a chunk runs past the end", f"{length} bytes", f"at most {end - start}")
        if number == 0:
            if kind != _JSON_CHUNK:
                _fail_byte(source, position + 4, "the first chunk is not JSON", f"{kind:#010x}", f"{_JSON_CHUNK:#x}")
            document = parse_json(source.data[start : start + length], source.name, start, "the JSON chunk")
        elif number == 1 and kind == _BINARY_CHUNK:
            binary = source.data[start : start + length]
        position, number = start + length, number + 1
    if document is None:
        _fail_byte(source, position, "the file ends before its JSON chunk")
    return document, binary


def _fail_byte(
    source: Source, byte: int, why: str, found: str | None = None, expected: str | None = None
) -> NoReturn:
    raise MeshFormatError(f"byte {byte}: {why}", source.name, found=found, expected=expected)
