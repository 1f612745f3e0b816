"""``dpvo.config.cfg``, with the names that DPVO gives its settings."""


class Settings(dict[str, object]):
    """A tree of yacs refuses names that it does not have, and values of another type."""

    def merge_from_list(self, entries):
        for name, value in zip(entries[::2], entries[1::2], strict=True):
            assert type(self[name]) is type(value), name
            self[name] = value


cfg = Settings(
    BUFFER_SIZE=2048,
    PATCHES_PER_FRAME=80,
    REMOVAL_WINDOW=20,
    OPTIMIZATION_WINDOW=12,
    PATCH_LIFETIME=12,
    KEYFRAME_INDEX=4,
    KEYFRAME_THRESH=12.5,
    MOTION_MODEL="DAMPED_LINEAR",
    MOTION_DAMPING=0.5,
    MIXED_PRECISION=True,
)
