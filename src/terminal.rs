//! Terminals that show pictures: which do, and how they are told.

use std::{env, ffi::OsStr, fs::File, io, os::unix::ffi::OsStrExt, time::Duration};

use base64::{Engine, prelude::BASE64_STANDARD};
use icy_sixel::{EncodeOptions, sixel_encode};
use rtfarm_core::tile::Area;
use rtfarm_picture::{View, encode_screen};
use rustix::{
    fs::{Mode, OFlags, open},
    io::Errno,
    process::getpgrp,
    termios::{
        LocalModes, OptionalActions, Termios, isatty, tcgetattr, tcgetpgrp, tcgetwinsize,
        tcsetattr, ttyname,
    },
};
use tokio::time::{sleep, timeout};

/// A terminal that has not answered after so long does not answer.
const PATIENCE: Duration = Duration::from_millis(500);

/// It is looked so often whether it has.
const PAUSE: Duration = Duration::from_millis(5);

/// The most pixels across and down of a picture that is shown: a coarse one is sent quickly.
const MOST_PIXELS: [u32; 2] = [400, 300];

/// What a character takes in pixels where the terminal does not say: hardly any takes less.
const CELL: [u32; 2] = [6, 12];

/// Asks for Kitty's graphics, how many colours a picture of sixels may have, and at last what the
/// terminal can do, which each terminal answers.
///
/// Source: K. Goyal, "Terminal graphics protocol", "Querying support"; E. Moy, S. Gildea, T.
/// Dickey, "`XTerm` Control Sequences", "Set or request graphics attribute".
const QUESTION: &[u8] = b"\x1b_Gi=31,s=1,v=1,a=q,t=d,f=24;AAAA\x1b\\\x1b[?1;1;0S\x1b[c";

/// Colours of a picture of sixels where the terminal does not say how many it has.
const COLORS: u16 = 256;

/// How a terminal is told of a picture.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Graphics {
    Kitty,
    Iterm2,
    /// By sixels of so many colours.
    Sixel(u16),
}

/// Why there is no terminal that shows pictures.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
pub(crate) enum NoGraphics {
    #[error("standard error is not a terminal")]
    NoTerminal,
    #[error(
        "this terminal shows no pictures, neither by Kitty's or iTerm2's protocol nor by sixels"
    )]
    Unknown,
    #[error(
        "this terminal did not say that it shows pictures, by Kitty's or iTerm2's protocol or by sixels"
    )]
    Silent,
    #[error("rtfarm is in the background")]
    Background,
}

/// What a terminal shows pictures by.
type Found = Result<Graphics, NoGraphics>;

/// A picture on its way to a terminal.
#[derive(Debug)]
pub(crate) struct Drawing {
    /// Draws it from where the cursor is, which may be moved by that.
    pub(crate) bytes: Vec<u8>,
    /// Rows of characters that it takes.
    pub(crate) rows: u16,
    /// Takes it away where clearing the characters does not.
    pub(crate) erase: String,
}

impl Graphics {
    /// What the terminal at standard error shows pictures by. It may be asked, and then has half a
    /// second to answer; when this is dropped before, the terminal is as it was.
    pub(crate) async fn detect() -> Found {
        let stderr = io::stderr();
        if !isatty(&stderr) {
            return Err(NoGraphics::NoTerminal);
        }
        match known(|name| env::var(name).ok()) {
            Some(known) => known,
            None => ask(&stderr).await.unwrap_or(Err(NoGraphics::Silent)),
        }
    }

    /// How much of a picture of that window fits into the upper half of the terminal.
    pub(crate) fn view(window: Area) -> View {
        let Room { columns, rows, cell } = Room::now();
        let most = [columns * cell[0], rows * cell[1]];
        View::within(window, [0, 1].map(|side| most[side].clamp(1, MOST_PIXELS[side])))
    }

    /// Draws pixels, `[y][x]`, red, green and blue. `id` is the picture's own.
    pub(crate) fn draw(self, pixels: &[u8], view: View, id: u32) -> io::Result<Drawing> {
        let Room { columns, rows, cell } = Room::now();
        let size = view.size();
        let [width, height] = [size.width(), size.height()];
        if let Self::Sixel(max_colors) = self {
            let opaque: Vec<u8> = pixels
                .chunks_exact(3)
                .flat_map(|pixel| [pixel[0], pixel[1], pixel[2], 255])
                .collect();
            let options = EncodeOptions { max_colors, ..EncodeOptions::default() };
            let drawn = sixel_encode(&opaque, width as usize, height as usize, &options);
            let bytes = drawn.map_err(io::Error::other)?.into_bytes();
            return Ok(Drawing {
                bytes,
                rows: height.div_ceil(cell[1]) as u16,
                erase: String::new(),
            });
        }
        let png = encode_screen(pixels, width)?;
        let text = BASE64_STANDARD.encode(&png);
        // The terminal scales it to so many rows.
        let fit = u64::from(columns * cell[0]) * u64::from(height) / u64::from(width * cell[1]);
        let rows = fit.clamp(1, rows.into()) as u16;
        let (bytes, erase) = if self == Self::Kitty {
            (kitty(&text, rows, id), format!("\x1b_Ga=d,d=I,i={id},q=2\x1b\\"))
        } else {
            let head = format!("File=inline=1;size={};height={rows}", png.len());
            (format!("\x1b]1337;{head};preserveAspectRatio=1:{text}\x07"), String::new())
        };
        Ok(Drawing { bytes: bytes.into_bytes(), rows, erase })
    }
}

/// A PNG in base 64 as Kitty wants it, in pieces of 4096 bytes; a picture of the same id goes.
fn kitty(text: &str, rows: u16, id: u32) -> String {
    let pieces: Vec<&[u8]> = text.as_bytes().chunks(4096).collect();
    let mut keys = format!("a=T,f=100,q=2,C=1,i={id},r={rows},");
    let lefts = (0..pieces.len()).rev();
    let told = lefts.zip(pieces).map(|(left, piece)| {
        let piece = str::from_utf8(piece).expect("base 64 is ASCII");
        let keys = std::mem::take(&mut keys);
        format!("\x1b_G{keys}m={};{piece}\x1b\\", u8::from(left > 0))
    });
    told.collect()
}

/// Characters in a row of the terminal at standard error, at least one.
pub(crate) fn columns() -> usize {
    Room::now().columns as usize
}

/// What the terminal has for a picture.
struct Room {
    /// Characters in a row.
    columns: u32,
    /// Half of its rows.
    rows: u32,
    /// A character's width and height in pixels.
    cell: [u32; 2],
}

impl Room {
    fn now() -> Self {
        let size = tcgetwinsize(io::stderr()).ok();
        let [columns, rows, width, height] = size.map_or([0; 4], |size| {
            [size.ws_col, size.ws_row, size.ws_xpixel, size.ws_ypixel].map(u32::from)
        });
        let [columns, rows] = if columns == 0 || rows == 0 { [80, 24] } else { [columns, rows] };
        let cell = [width / columns, height / rows];
        let cell = if cell.contains(&0) { CELL } else { cell };
        Self { columns, rows: (rows / 2).max(1), cell }
    }
}

/// What is known of a terminal by its variables: it shows pictures so, or shows none. Otherwise it
/// must be asked.
fn known(variable: impl Fn(&str) -> Option<String>) -> Option<Found> {
    let value = |name| variable(name).unwrap_or_default();
    let term = value("TERM");
    if ["", "dumb", "linux"].contains(&&*term) {
        return Some(Err(NoGraphics::Unknown));
    }
    // What is between has a terminal's variables, but may not let pictures through.
    let is_between =
        !value("TMUX").is_empty() || ["tmux", "screen"].iter().any(|name| term.starts_with(name));
    if is_between {
        return None;
    }
    let program = value("TERM_PROGRAM");
    if term.contains("kitty") || term.contains("ghostty") || program == "ghostty" {
        return Some(Ok(Graphics::Kitty));
    }
    let is_iterm2 = ["iTerm.app", "WezTerm", "mintty"].contains(&&*program);
    (is_iterm2 || value("LC_TERMINAL") == "iTerm2").then_some(Ok(Graphics::Iterm2))
}

/// Asks a terminal.
async fn ask(terminal: &io::Stderr) -> io::Result<Found> {
    let name = ttyname(terminal, Vec::new())?;
    let flags = OFlags::RDWR | OFlags::NOCTTY | OFlags::NONBLOCK | OFlags::CLOEXEC;
    let terminal = File::from(open(OsStr::from_bytes(name.as_bytes()), flags, Mode::empty())?);
    // Who is in the background would be stopped.
    if tcgetpgrp(&terminal).is_ok_and(|foreground| foreground != getpgrp()) {
        return Ok(Err(NoGraphics::Background));
    }
    let asked = Asked::open(terminal)?;
    rustix::io::write(&asked.terminal, QUESTION)?;
    timeout(PATIENCE, asked.answer()).await.unwrap_or(Ok(Err(NoGraphics::Silent)))
}

/// A terminal that does not show what it answers, as long as this lives.
struct Asked {
    terminal: File,
    before: Termios,
}

impl Asked {
    fn open(terminal: File) -> io::Result<Self> {
        let before = tcgetattr(&terminal)?;
        let mut quiet = before.clone();
        quiet.local_modes -= LocalModes::ICANON | LocalModes::ECHO;
        tcsetattr(&terminal, OptionalActions::Now, &quiet)?;
        Ok(Self { terminal, before })
    }

    /// Reads until the last answer has come.
    async fn answer(&self) -> io::Result<Found> {
        let mut said = Vec::new();
        loop {
            let mut bytes = [0; 256];
            let count = match rustix::io::read(&self.terminal, &mut bytes) {
                Err(Errno::AGAIN) => {
                    sleep(PAUSE).await;
                    continue;
                }
                read => read?,
            };
            said.extend_from_slice(&bytes[..count]);
            if let Some(found) = graphics(&said) {
                return Ok(found);
            }
            if count == 0 {
                return Ok(Err(NoGraphics::Silent));
            }
        }
    }
}

impl Drop for Asked {
    fn drop(&mut self) {
        let _ = tcsetattr(&self.terminal, OptionalActions::Now, &self.before);
    }
}

/// What a terminal shows pictures by, by all that it answered; `None` until it has. Its last answer
/// is what it can do, where 4 stands for sixels.
///
/// Source: Digital Equipment Corporation, "VT330/VT340 Programmer Reference Manual" (1987),
/// "Primary DA".
fn graphics(said: &[u8]) -> Option<Found> {
    let said = String::from_utf8_lossy(said);
    let answers = || said.split("\x1b[?").skip(1);
    let able = answers().find_map(|answer| answer.split_once('c'))?.0;
    if said.contains("Gi=31;OK") {
        return Some(Ok(Graphics::Kitty));
    }
    let colors = answers().find_map(|answer| answer.strip_prefix("1;0;")?.split_once('S'));
    let colors = colors.and_then(|(colors, _)| colors.parse().ok()).unwrap_or(COLORS);
    let has_sixels = able.split(';').any(|number| number == "4");
    let sixels = has_sixels.then_some(Graphics::Sixel(colors.clamp(2, COLORS)));
    Some(sixels.ok_or(NoGraphics::Unknown))
}

#[cfg(test)]
mod tests {
    use super::*;

    const NONE: Option<Found> = Some(Err(NoGraphics::Unknown));

    #[test]
    fn a_terminal_is_known_by_its_variables_or_must_be_asked() {
        let kitty = Some(Ok(Graphics::Kitty));
        let iterm2 = Some(Ok(Graphics::Iterm2));
        let xterm = ("TERM", "xterm-256color");
        for (variables, expected) in [
            (vec![], NONE),
            (vec![("TERM", "dumb"), ("TERM_PROGRAM", "iTerm.app")], NONE),
            (vec![xterm], None),
            (vec![("TERM", "xterm-kitty")], kitty),
            (vec![("TERM", "xterm-ghostty")], kitty),
            (vec![("TERM", "xterm-kitty"), ("TMUX", "/tmp/tmux")], None),
            (vec![("TERM", "screen-256color"), ("LC_TERMINAL", "iTerm2")], None),
            (vec![xterm, ("TERM_PROGRAM", "WezTerm")], iterm2),
            (vec![xterm, ("LC_TERMINAL", "iTerm2")], iterm2),
            (vec![xterm, ("TERM_PROGRAM", "vscode")], None),
        ] {
            let value = |name: &str| {
                let found = variables.iter().find(|(known, _)| *known == name);
                found.map(|(_, value)| (*value).to_owned())
            };
            assert_eq!(known(value), expected, "{variables:?}");
        }
    }

    #[test]
    fn an_answer_is_whole_or_waited_for() {
        let sixel = |colors| Some(Ok(Graphics::Sixel(colors)));
        for (said, expected) in [
            ("", None),
            ("x\x1b[?62;4;2", None),
            ("\x1b_Gi=31;OK\x1b\\", None),
            ("\x1b_Gi=31;OK\x1b\\\x1b[?62;4;22c", Some(Ok(Graphics::Kitty))),
            ("\x1b[?1;0;16S", None),
            ("\x1b[?1;0;16S\x1b[?63;1;2;4;9c", sixel(16)),
            ("\x1b[?1;0;1024S\x1b[?62;4c", sixel(256)),
            ("\x1b[?1;3;0S\x1b[?62;4;22c", sixel(256)),
            ("\x1b[?62;4;22c", sixel(256)),
            ("\x1b[?1;0;1024S\x1b[?64;1;14;44c", NONE),
        ] {
            assert_eq!(graphics(said.as_bytes()), expected, "{said:?}");
        }
    }

    #[test]
    fn kitty_gets_a_picture_in_pieces() {
        let text = "x".repeat(4096 + 4);
        let drawn = kitty(&text, 7, 9);
        let pieces: Vec<&str> = drawn.split_terminator("\x1b\\").collect();
        assert_eq!(pieces.len(), 2);
        assert!(pieces[0].starts_with("\x1b_Ga=T,f=100,q=2,C=1,i=9,r=7,m=1;x"));
        assert_eq!(pieces[1], "\x1b_Gm=0;xxxx");
    }
}
