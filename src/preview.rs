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
    time::sleep,
};
use tokio_util::sync::CancellationToken;

use crate::{console::Console, console_queue::ConsoleQueue, failure::Failure, terminal::Graphics};

/// The picture is drawn so often, if there is more to see.
const PERIOD: Duration = Duration::from_millis(500);

/// What a view shows of a picture now: `[y][x]`, red, green and blue.
type Look = Arc<dyn Fn(View) -> io::Result<Vec<u8>> + Send + Sync>;

/// A terminal that is to show pictures.
#[derive(Debug)]
pub(crate) struct Screen {
    graphics: Graphics,
    queue: ConsoleQueue,
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
                let queue = console.queue().cloned();
                Ok(queue.map(|queue| Self { graphics, queue, count: AtomicU32::new(0) }))
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
            queue: self.queue.clone(),
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
        (&mut self.drawing).await.expect("nothing here panics");
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
    queue: ConsoleQueue,
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
            // A terminal that takes nothing gets the last picture, if it takes more again.
            if self.queue.is_drawing() && !is_last {
                continue;
            }
            let painter = self.clone();
            let painting = spawn_blocking(move || painter.paint_once(&seen));
            match painting.await.expect("nothing here panics") {
                Ok(now) => seen = now,
                Err(error) => return tracing::warn!(reason = %error, "there is no more preview"),
            }
            if is_last {
                self.queue.leave_picture();
                return;
            }
        }
    }

    /// Draws the picture if it is another than the one that was seen last. Answers with what is
    /// seen.
    fn paint_once(&self, seen: &[u8]) -> io::Result<Vec<u8>> {
        let view = Graphics::view(self.window);
        let pixels = (self.look)(view)?;
        if pixels != seen || !self.queue.has_picture() {
            self.queue.draw(self.graphics.draw(&pixels, view, self.id)?);
        }
        Ok(pixels)
    }
}
