"""Options that several verbs share."""

from turbnet.errors import InputError


def parse_crop(text: str | None) -> tuple[int, int, int, int] | None:
    """LEFT,TOP,WIDTH,HEIGHT in pixels as four integers; None stays None.

    Raises:
        InputError: anything else.
    """
    if text is None:
        return None
    try:
        left, top, width, height = (int(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(f"--crop {text}: give LEFT,TOP,WIDTH,HEIGHT in pixels, such as 100,40,256,256") from error
    return left, top, width, height
