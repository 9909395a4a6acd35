//! `--preview`: a coarse picture in the terminal, again and again while it is rendered.

use std::{
    io,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::Duration,
};

use rtfarm_core::tile::Area;
use rtfarm_picture::View;
use tokio::{
    task::{JoinHandle, spawn_blocking},
    time::{sleep, timeout},
};
use tokio_util::sync::CancellationToken;

use crate::{console::Console, failure::Failure, terminal::Graphics};

/// The picture is drawn so often, if there is more to see.
const PERIOD: Duration = Duration::from_millis(500);

/// The longest that a picture which is ready waits for a terminal.
const PATIENCE: Duration = Duration::from_secs(1);

/// What a view shows of a picture now: `[y][x]`, red, green and blue.
type Look = Arc<dyn Fn(View) -> io::Result<Vec<u8>> + Send + Sync>;

/// A terminal that is to show pictures.
#[derive(Debug)]
pub(crate) struct Screen {
    graphics: Graphics,
    console: Console,
    /// Pictures that it has shown.
    count: AtomicU32,
}

impl Screen {
    /// The terminal at standard error; `None`, which is told, where it shows no pictures.
    pub(crate) async fn open(
        console: &Console,
        stop: &CancellationToken,
    ) -> Result<Option<Self>, Failure> {
        let found = stop.run_until_cancelled(Graphics::detect()).await;
        match found.ok_or(Failure::Interrupted)? {
            Ok(graphics) => {
                let console = console.clone();
                Ok(Some(Self { graphics, console, count: AtomicU32::new(0) }))
            }
            Err(reason) => {
                tracing::warn!("there is no preview: {reason}");
                Ok(None)
            }
        }
    }

    /// Shows a picture of that window from now on.
    pub(crate) fn begin(
        &self,
        window: Area,
        look: impl Fn(View) -> io::Result<Vec<u8>> + Send + Sync + 'static,
    ) -> Preview {
        let number = self.count.fetch_add(1, Ordering::Relaxed) % 1024;
        let painter = Painter {
            graphics: self.graphics,
            console: self.console.clone(),
            window,
            look: Arc::new(look),
            // No other picture in the terminal has it, as long as processes' numbers differ.
            id: (std::process::id() << 10) + number,
        };
        let stop = CancellationToken::new();
        Preview { drawing: tokio::spawn(painter.paint(stop.clone())), stop }
    }
}

/// A picture in the terminal, which is drawn again until this ends.
#[derive(Debug)]
pub(crate) struct Preview {
    stop: CancellationToken,
    drawing: JoinHandle<()>,
}

impl Preview {
    /// Draws the picture as it is for the last time; it stays.
    pub(crate) async fn end(mut self) {
        self.stop.cancel();
        // Who does not read is not waited for.
        let _ = timeout(PATIENCE, &mut self.drawing).await;
    }
}

impl Drop for Preview {
    fn drop(&mut self) {
        self.stop.cancel();
    }
}

#[derive(Clone)]
struct Painter {
    graphics: Graphics,
    console: Console,
    window: Area,
    look: Look,
    id: u32,
}

impl Painter {
    async fn paint(self, stop: CancellationToken) {
        let mut seen = Vec::new();
        loop {
            let is_last = tokio::select! {
                () = stop.cancelled() => true,
                () = sleep(PERIOD) => false,
            };
            let painter = self.clone();
            let painting = spawn_blocking(move || painter.paint_once(&seen));
            match painting.await.expect("nothing here panics") {
                Ok(now) => seen = now,
                Err(error) => return tracing::warn!(reason = %error, "there is no more preview"),
            }
            if is_last {
                self.console.leave_picture();
                return;
            }
        }
    }

    /// Draws the picture if it is another than the one that was seen last. Answers with what is seen.
    fn paint_once(&self, seen: &[u8]) -> io::Result<Vec<u8>> {
        let view = Graphics::view(self.window);
        let pixels = (self.look)(view)?;
        if pixels != seen || !self.console.has_picture() {
            self.console.draw(self.graphics.draw(&pixels, view, self.id)?);
        }
        Ok(pixels)
    }
}
