"""The content of a ``tokenizer.json`` from elsewhere: parsed, or refused with a sentence."""

from tokenizers import Tokenizer, normalizers


def parsed_tokenizer(content: bytes) -> Tokenizer:
    """Parses a tokenizer; raises ValueError if it is none, or none that is read here."""
    try:
        tokenizer = Tokenizer.from_buffer(content)
    except BaseException as error:
        if not isinstance(error, Exception) and type(error).__name__ != "PanicException":  # Rust's, not importable
            raise
        raise ValueError(f"no tokenizer.json, or one that was cut short: {error}") from None
    # Qwen3.5's and Eagle's have NFC or none; others may blow a text up without end, or panic.
    if tokenizer.normalizer is not None and not isinstance(tokenizer.normalizer, normalizers.NFC):
        raise ValueError(f"the normalizer is {type(tokenizer.normalizer).__name__}, expected NFC or none")
    return tokenizer
