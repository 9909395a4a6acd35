//! Whether a file is a text at all.

use super::diagnostic::Report;

/// Reports what is not UTF-8 in a text, and answers whether its words may make sense all the same.
pub(super) fn check_encoding(text: &[u8], report: &mut Report) -> bool {
    let head = &text[..text.len().min(1024)];
    if let [0x1f, 0x8b, ..] = text {
        report.error(0..2, || "this file is compressed with gzip; unpack it first".into());
        return false;
    }
    if let [0xff, 0xfe, ..] | [0xfe, 0xff, ..] = text {
        report.error(0..2, || "this file is in UTF-16; save it as UTF-8".into());
        return false;
    }
    if let Some(at) = memchr::memchr(0, head) {
        report.error(at..at + 1, || "this file is not a text: it contains a NUL byte".into());
        return false;
    }
    if let Err(error) = std::str::from_utf8(text) {
        let at = error.valid_up_to();
        let length = error.error_len().unwrap_or(text.len() - at);
        report.error(at..at + length, || {
            format!("the byte 0x{:02x} is not valid UTF-8; save the file as UTF-8", text[at])
        });
    }
    true
}
