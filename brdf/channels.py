"""What the channels of a picture or a material are called where a person reads of them."""

MOST_CHANNELS = 4096
"""Of a picture, a material or a measured table: more are no spectrum."""


def channel_names(count: int) -> tuple[str, ...]:
    """Names of channels: nothing for one, red, green and blue for three, numbers from 0 for others."""
    if count == 1:
        return ("",)
    return ("red", "green", "blue") if count == 3 else tuple(map(str, range(count)))


def in_channel(channel: int, count: int) -> str:
    """The end of a sentence that says in which channel, as ", channel blue"; nothing where there is one."""
    return f", channel {channel_names(count)[channel]}" if count > 1 else ""
