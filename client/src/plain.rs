//! Text from others as it may reach a terminal or a log.

/// Leaves out control characters, by which a text could command a terminal; lines and tabs stay.
pub fn plain(text: &str) -> String {
    text.chars().filter(|&c| !c.is_control() || matches!(c, '\n' | '\t')).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn text_from_others_cannot_command_a_terminal() {
        let text = "a\x1b[2Jb\x07c\u{9b}31md\r\n\te\x08\x7f";
        assert_eq!(plain(text), "a[2Jbc31md\n\te");
    }
}
