//! Finds libmujoco for the linker and the loader, and lists the robots' files for the program to hold.

use std::{
    env, io,
    path::{Path, PathBuf},
};

const LIBRARY: &str = "libmujoco.so.3.17.0";

fn main() -> io::Result<()> {
    let here = PathBuf::from(env::var_os("CARGO_MANIFEST_DIR").unwrap_or_default());
    link(&here);
    list_assets(&here)
}

/// mujoco-rs asks for `mujoco` in the folder of `MUJOCO_DYNAMIC_LINK_DIR`. Where the user set none that is `link/`,
/// whose file leads the linker on; so a missing library is found here, and said in one sentence, not there.
fn link(here: &Path) {
    println!("cargo::rerun-if-env-changed=MUJOCO_DYNAMIC_LINK_DIR");
    let named = env::var_os("MUJOCO_DYNAMIC_LINK_DIR").map(PathBuf::from);
    let users =
        named.filter(|folder| folder.canonicalize().ok() != here.join("link").canonicalize().ok());
    let provided = || here.with_file_name(".mujoco").join("lib");
    let folder = users.unwrap_or_else(provided);
    println!("cargo::rerun-if-changed={}", folder.display());
    if !folder.join(LIBRARY).exists() && !folder.join("libmujoco.so").exists() {
        println!(
            "cargo::error=MuJoCo 3.17.0 is not set up: run `cargo xtask setup`, or set MUJOCO_DYNAMIC_LINK_DIR to its lib folder"
        );
        return;
    }
    println!("cargo::rustc-link-search=native={}", folder.display());
    println!(
        "cargo::rustc-link-arg=-Wl,--disable-new-dtags,-rpath,{},-rpath,$ORIGIN/../lib",
        folder.display()
    );
}

/// Writes `[(file name, bytes)]` of each robot: MuJoCo reads them from memory, so that the program needs no folder.
fn list_assets(here: &Path) -> io::Result<()> {
    let out = PathBuf::from(env::var_os("OUT_DIR").unwrap_or_default());
    for robot in ["panda", "sawyer"] {
        let folder = here.join("assets").join(robot);
        println!("cargo::rerun-if-changed={}", folder.display());
        let mut files = vec![folder.with_extension("xml")];
        for entry in fs_err::read_dir(&folder)? {
            files.push(entry?.path());
        }
        files.sort();
        let mut lines = String::new();
        for file in &files {
            let name = file.file_name().unwrap_or_default().to_string_lossy();
            let path = file.to_string_lossy();
            lines.push_str(&format!("({name:?}, include_bytes!({path:?})),\n"));
        }
        fs_err::write(out.join(format!("{robot}.rs")), format!("&[\n{lines}]"))?;
    }
    Ok(())
}
