"""Text from files and file names as a terminal, a page and a table may have it."""


def printable(text: str) -> str:
    """Return text on one line without anything that a terminal would obey, written as escapes instead.

    Control characters, line ends, marks that turn the direction of writing, and bytes of file names that are not UTF-8.
    """
    return text if text.isprintable() else "".join(c if c.isprintable() else _escape(c) for c in text)


def encodable(text: str) -> str:
    """Return text that UTF-8 can hold: bytes of file names that are not UTF-8 written as escapes."""
    return "".join(_escape(c) if "\ud800" <= c <= "\udfff" else c for c in text) if not text.isascii() else text


def _escape(character: str) -> str:
    code = ord(character)
    if 0xDC80 <= code <= 0xDCFF:
        # So Python keeps the byte of a name that is not UTF-8.
        return f"\\x{code - 0xDC00:02x}"
    return character.encode("unicode_escape", "surrogatepass").decode()
