//! `rtfarm completions` and `rtfarm man`: what a shell and `man` know of the command line.

use std::{fs, io};

use anyhow::Context;
use clap::CommandFactory;
use clap_mangen::Man;

use crate::{
    args::{Args, CompletionsArgs, ManArgs},
    failure::Failure,
};

pub(crate) fn write_completions(args: &CompletionsArgs) -> Result<(), Failure> {
    let mut script = Vec::new();
    clap_complete::generate(args.shell, &mut Args::command(), "rtfarm", &mut script);
    io::Write::write_all(&mut io::stdout().lock(), &script)
        .context("cannot write to standard output")?;
    Ok(())
}

pub(crate) fn write_pages(args: &ManArgs) -> Result<(), Failure> {
    let folder = &args.folder;
    let context = || format!("cannot write manual pages into {}", folder.display());
    fs::create_dir_all(folder).with_context(context)?;
    let mut program = Args::command();
    program.build();
    write_page(&program, folder).with_context(context)?;
    for command in program.get_subcommands().filter(|command| !command.is_hide_set()) {
        write_page(command, folder).with_context(context)?;
    }
    Ok(())
}

fn write_page(command: &clap::Command, folder: &std::path::Path) -> io::Result<()> {
    let man = Man::new(command.clone());
    let mut page = Vec::new();
    man.render(&mut page)?;
    let mut file = tempfile::NamedTempFile::new_in(folder)?;
    io::Write::write_all(&mut file, &page)?;
    file.persist(folder.join(man.get_filename())).map_err(io::Error::from)?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn each_command_has_a_page_and_no_page_is_left_half_written() {
        let folder = tempfile::tempdir().unwrap();
        write_pages(&ManArgs { folder: folder.path().join("man1") }).unwrap();
        let names: Vec<_> = fs::read_dir(folder.path().join("man1"))
            .unwrap()
            .map(|entry| entry.unwrap().file_name().into_string().unwrap())
            .collect();
        for name in ["rtfarm.1", "rtfarm-render.1", "rtfarm-submit.1"] {
            assert!(names.iter().any(|found| found == name), "{name}: {names:?}");
        }
        assert!(names.iter().all(|name| name.ends_with(".1")), "{names:?}");
        write_pages(&ManArgs { folder: "/dev/null/man".into() }).unwrap_err();
    }

    #[test]
    fn shells_are_told_every_command() {
        for shell in
            [clap_complete::Shell::Bash, clap_complete::Shell::Zsh, clap_complete::Shell::Fish]
        {
            let mut script = Vec::new();
            clap_complete::generate(shell, &mut Args::command(), "rtfarm", &mut script);
            let script = String::from_utf8(script).unwrap();
            for command in Args::command().get_subcommands() {
                assert!(script.contains(command.get_name()), "{shell}: {}", command.get_name());
            }
        }
    }
}
