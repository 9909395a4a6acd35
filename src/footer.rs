//! What stands below all lines on a terminal: a picture, and the bar under it.

use std::io::{self, Write};

use crate::{
    console_queue::{Batch, Item, pieces},
    terminal::Drawing,
};

/// What stands there now.
#[derive(Debug, Default)]
pub(crate) struct Footer {
    picture: Option<Shown>,
    has_bar: bool,
}

/// A picture on the screen.
#[derive(Debug)]
struct Shown {
    /// Rows that it takes.
    rows: u16,
    /// Takes it away where clearing its rows does not.
    erase: String,
}

impl Shown {
    /// Moves to its first row and clears it, and all below.
    fn clear(self) -> String {
        let Self { rows, erase } = self;
        format!("\r\x1b[{rows}A{erase}\x1b[J")
    }
}

impl Footer {
    /// Writes lines in place of the picture, then the picture and a bar of at most so many
    /// characters. Lines for standard output go to `answers`.
    pub(crate) fn write(
        &mut self,
        batch: Batch,
        columns: usize,
        mut out: impl Write,
        mut answers: impl Write,
    ) -> io::Result<()> {
        let Batch { items, picture, bar } = batch;
        let mut bytes = Vec::new();
        if self.has_bar {
            bytes.extend_from_slice(b"\r\x1b[K");
        }
        for item in items {
            match item {
                Item::Lines(lines) => {
                    self.clear_picture(&mut bytes);
                    bytes.extend(lines);
                }
                Item::Answer(line) => {
                    self.clear_picture(&mut bytes);
                    out.write_all(&bytes)?;
                    bytes.clear();
                    answers.write_all(&line)?;
                    answers.flush()?;
                }
                Item::Leave(picture) => {
                    if let Some(picture) = picture {
                        self.draw(picture, &mut bytes);
                    }
                    self.picture = None;
                }
            }
        }
        if let Some(picture) = picture {
            self.draw(picture, &mut bytes);
        }
        self.has_bar = bar.is_some();
        bytes.extend(bar.into_iter().flat_map(|bar| {
            let fitting: String = bar.chars().take(columns).collect();
            fitting.into_bytes()
        }));
        pieces(&bytes).try_for_each(|piece| out.write_all(piece))
    }

    fn clear_picture(&mut self, bytes: &mut Vec<u8>) {
        bytes.extend(self.picture.take().map(Shown::clear).unwrap_or_default().into_bytes());
    }

    /// Draws a picture in place of the one that is there. The cursor is in the row below it at the
    /// end.
    fn draw(&mut self, drawing: Drawing, bytes: &mut Vec<u8>) {
        let Drawing { bytes: drawn, rows, erase } = drawing;
        match self.picture.take() {
            // The new one covers it.
            Some(old) if old.rows == rows => bytes.extend(format!("\r\x1b[{rows}A").into_bytes()),
            old => bytes.extend(old.map(Shown::clear).unwrap_or_default().into_bytes()),
        }
        // Its rows come into view first, so that nothing is moved while it is drawn.
        bytes.extend("\n".repeat(rows.into()).into_bytes());
        bytes.extend(format!("\x1b[{rows}A\x1b7").into_bytes());
        bytes.extend(drawn);
        bytes.extend(format!("\x1b8\x1b[{rows}B\r").into_bytes());
        self.picture = Some(Shown { rows, erase });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// What is written for each of several batches, one after the other, to a terminal ten
    /// characters wide.
    fn check_written(batches: Vec<(Batch, &str)>) {
        let mut footer = Footer::default();
        for (number, (batch, expected)) in batches.into_iter().enumerate() {
            let out = std::cell::RefCell::new(Vec::new());
            footer.write(batch, 10, Both(&out), Both(&out)).unwrap();
            assert_eq!(String::from_utf8(out.into_inner()).unwrap(), expected, "batch {number}");
        }
    }

    /// Standard error and standard output, which are the same terminal.
    struct Both<'a>(&'a std::cell::RefCell<Vec<u8>>);

    impl Write for Both<'_> {
        fn write(&mut self, bytes: &[u8]) -> io::Result<usize> {
            self.0.borrow_mut().write(bytes)
        }

        fn flush(&mut self) -> io::Result<()> {
            Ok(())
        }
    }

    #[test]
    fn lines_take_the_place_of_a_picture_and_a_bar_which_are_below_all() {
        let lines = |text: &str| Item::Lines(text.into());
        let answer = |text: &str| Item::Answer(text.into());
        let picture =
            |name: &str, rows| Drawing { bytes: name.into(), rows, erase: format!("<no {name}>") };
        let bar = |text: &str| Some(text.to_owned());
        let drawn = |name: &str| format!("\n\n\x1b[2A\x1b7{name}\x1b8\x1b[2B\r");
        let (a, b) = (drawn("A"), drawn("B"));
        check_written(vec![
            (Batch { items: vec![lines("one\n")], ..Batch::default() }, "one\n"),
            (Batch { bar: bar("bar of 0123"), ..Batch::default() }, "bar of 012"),
            (
                Batch {
                    items: vec![lines("two\n")],
                    picture: Some(picture("A", 2)),
                    bar: bar("1"),
                },
                &format!("\r\x1b[Ktwo\n{a}1"),
            ),
            (
                Batch { items: vec![], picture: Some(picture("B", 2)), bar: bar("2") },
                &format!("\r\x1b[K\r\x1b[2A{b}2"),
            ),
            (
                Batch { items: vec![answer("end\n")], picture: None, bar: bar("3") },
                "\r\x1b[K\r\x1b[2A<no B>\x1b[Jend\n3",
            ),
            (
                Batch {
                    items: vec![Item::Leave(Some(picture("A", 2))), answer("done\n")],
                    ..Batch::default()
                },
                &format!("\r\x1b[K{a}done\n"),
            ),
        ]);
    }
}
