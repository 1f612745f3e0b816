"""Video in messages (H.264, H.265 and others), decoded packet by packet to plain pictures.

A packet is no picture of its own: it changes the one before, so packets are decoded in order from the first that holds
a whole picture. PyAV does it, an optional library with FFmpeg in it.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING, Any, Generic, TypeVar

import numpy as np
from rosbags.typesys import get_types_from_msg

from slamhive.base.errors import InvalidInput
from slamhive.runtime.messages import COMPRESSED_IMAGE, Array

if TYPE_CHECKING:
    import av

COMPRESSED_VIDEO = "foxglove_msgs/msg/CompressedVideo"
FFMPEG_PACKET = "ffmpeg_image_transport_msgs/msg/FFMPEGPacket"
VIDEO_TYPES = (COMPRESSED_VIDEO, FFMPEG_PACKET)
VIDEO_DEFINITIONS: Mapping[str, Any] = {
    **get_types_from_msg(
        "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format", COMPRESSED_VIDEO
    ),
    **get_types_from_msg(
        "std_msgs/Header header\nint32 width\nint32 height\nstring encoding\nuint64 pts\nuint8 flags\n"
        "bool is_bigendian\nuint8[] data",
        FFMPEG_PACKET,
    ),
}
"""For recordings that do not define their types. Source: foxglove-sdk and ffmpeg_image_transport_msgs."""
_CODECS = {"264": "h264", "265": "hevc", "hevc": "hevc", "av1": "av1", "vp9": "vp9"}
"""Decoders by a part of the encoding, which may be ``h264``, ``hevc_nvenc``, ``libx264`` or ``h264;yuv420p``."""
Moment = TypeVar("Moment")
_LATEST_START = 1000
"""Encoders send whole pictures every few seconds; a stream without one among its first packets has none."""


@dataclass(frozen=True, slots=True)
class _Stamp:
    sec: int
    nanosec: int


@dataclass(frozen=True, slots=True)
class _Header:
    stamp: _Stamp
    frame_id: str


@dataclass(frozen=True, slots=True)
class VideoPacket:
    """A message of video as all readers of messages expect it: with a header, like ``CompressedImage``."""

    header: _Header
    format: str
    data: Array

    @classmethod
    def of(cls, message: Any, kind: str) -> VideoPacket:
        """The packet in a message of one of :data:`VIDEO_TYPES`."""
        if kind == FFMPEG_PACKET:
            stamp, frame_id, encoding = message.header.stamp, message.header.frame_id, message.encoding
        else:
            stamp, frame_id, encoding = message.timestamp, message.frame_id, message.format
        return cls(_Header(_Stamp(stamp.sec, stamp.nanosec), str(frame_id)), str(encoding), message.data)


def codec_of(message: Any, kind: str) -> str | None:
    """FFmpeg's name of the decoder for a message: empty for an unknown codec, None if it is no video."""
    if kind not in (*VIDEO_TYPES, COMPRESSED_IMAGE):
        return None
    encoding = str(message.format).lower()
    found = next((codec for part, codec in _CODECS.items() if part in encoding), "")
    return found if found or kind != COMPRESSED_IMAGE else None


class VideoDecoder(Generic[Moment]):
    """Decodes the packets of one topic in their order, each with the moment that its picture belongs to.

    Encoders may send pictures in another order than they are shown in, so a picture can come with a later packet.

    Args:
        codec: FFmpeg's name of the decoder.

    Raises:
        InvalidInput: PyAV is not installed.
    """

    def __init__(self, codec: str) -> None:
        try:
            import av  # noqa: PLC0415 - optional
        except ImportError:
            raise InvalidInput("video needs PyAV", "pip install 'slamhive[video]'") from None
        self._av = av
        self._codec = codec
        self._fed = 0
        self._seen = False
        self._moments: dict[int, Moment] = {}

    def pictures(self, data: Array, moment: Moment) -> Iterator[tuple[Moment, Array]]:
        """The pictures (h, w, 3) uint8 in red, green, blue that this packet completes, each with its own moment.

        Packets before the first whole picture give none. Raises InvalidInput for a damaged packet after it.
        """
        packet = self._av.Packet(np.asarray(data, dtype=np.uint8).tobytes())
        packet.pts = packet.dts = self._fed
        self._moments[self._fed] = moment
        self._fed += 1
        if packet.size:  # an empty one would end the stream
            yield from self._decoded(packet)

    def rest(self) -> Iterator[tuple[Moment, Array]]:
        """The pictures that wait for later packets, at the end of the stream."""
        yield from self._decoded(None)

    @cached_property
    def _context(self) -> av.VideoCodecContext:
        context = self._av.CodecContext.create(self._codec, "r")
        assert isinstance(context, self._av.VideoCodecContext)
        context.thread_type = "SLICE"  # threads by frame hold pictures back
        return context

    def _decoded(self, packet: av.Packet[Any] | None) -> Iterator[tuple[Moment, Array]]:
        try:
            frames = self._context.decode(packet)
        except self._av.FFmpegError as error:
            if not self._seen:
                return
            raise InvalidInput(
                f"packet {self._fed} of the video cannot be decoded: {error.strerror}", "copy the recording again"
            ) from None
        for frame in frames:
            self._seen = True
            assert frame.pts is not None
            yield self._moments.pop(frame.pts), frame.to_ndarray(format="rgb24")


def first_picture(codec: str, packets: Iterable[Any]) -> tuple[int, Array]:
    """The number of the first packet that holds a whole picture, and the picture.

    Raises InvalidInput if PyAV is not installed, or none of the first packets holds one.
    """
    decoder = VideoDecoder[int](codec)
    for number, packet in enumerate(packets):
        found = next(decoder.pictures(packet.data, number), None)
        if found is not None:
            return found
        if number >= _LATEST_START:
            break
    found = next(decoder.rest(), None)
    if found is None:
        raise InvalidInput("none of the first video packets holds a whole picture", "record from a key frame on")
    return found
