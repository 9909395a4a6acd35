//! `--show`: the page of a render, for this user alone.

use std::{
    env, fs,
    io::{self, Write},
    path::Path,
    process::{Command, Stdio},
};

use anyhow::Context;
use rtfarm_coordinator::Coordinator;
use tokio::net::TcpListener;

use crate::console::Console;

/// Serves the page on this machine and opens it, or says where it is. `folder` is this user's
/// alone.
pub(crate) async fn show(
    coordinator: &Coordinator,
    folder: &Path,
    console: &Console,
) -> anyhow::Result<()> {
    let listener = TcpListener::bind("127.0.0.1:0").await.context("cannot show the picture")?;
    let mut bytes = [0; 32];
    rustix::rand::getrandom(&mut bytes, rustix::rand::GetRandomFlags::empty())?;
    // Others on this machine reach the port, too.
    let token = blake3::Hash::from_bytes(bytes).to_hex().to_string();
    let address = format!("http://{}/#token={token}", listener.local_addr()?);
    let coordinator = coordinator.clone();
    tokio::spawn(async move {
        if let Err(error) = coordinator.show(listener, &token).await {
            tracing::warn!(reason = %error, "the picture is shown no more");
        }
    });
    if !open(folder, &address) {
        console.tell(&format!("the picture is shown at {address}"));
    }
    Ok(())
}

/// Opens an address where this user looks at pages; says whether that was possible. Others may read
/// a program's arguments, so the address is in a file.
fn open(folder: &Path, address: &str) -> bool {
    let has_screen = ["DISPLAY", "WAYLAND_DISPLAY"].iter().any(|name| env::var_os(name).is_some());
    let path = folder.join("show.html");
    let write = || -> io::Result<()> {
        let mut file = fs::File::create_new(&path)?;
        write!(file, "<!doctype html><meta http-equiv=refresh content=\"0; url={address}\">")
    };
    let open = || {
        let mut command = Command::new("xdg-open");
        let command = command.arg(&path).stdin(Stdio::null());
        command.stdout(Stdio::null()).stderr(Stdio::null()).status()
    };
    has_screen && write().is_ok() && open().is_ok_and(|status| status.success())
}
