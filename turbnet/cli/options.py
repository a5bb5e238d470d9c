"""Options that several verbs share."""

from turbnet.errors import InputError, check_range


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


def parse_wavelengths(text: str) -> tuple[float, ...]:
    """RED,GREEN,BLUE in metres.

    Raises:
        InputError: anything but three numbers between 0.1 and 20 micrometres.
    """
    try:
        red, green, blue = (float(part) for part in text.split(","))
    except ValueError as error:
        raise InputError(
            f"--wavelengths {text}: give RED,GREEN,BLUE in metres, such as 620e-9,535e-9,460e-9"
        ) from error
    return tuple(check_range("wavelength", value, 1e-7, 2e-5, "m") for value in (red, green, blue))
