//! Finds OpenVDB and compiles the bridge to it (`cpp/`). Does nothing without the feature `openvdb`.

fn main() {
    #[cfg(feature = "openvdb")]
    if let Err(problem) = bridge::build() {
        eprintln!("\nvdb-edit cannot be built with OpenVDB: {problem}\n");
        eprintln!("Without reading and writing .vdb files it builds with `--no-default-features --features cli`.\n");
        std::process::exit(1);
    }
    #[cfg(not(feature = "openvdb"))]
    println!("cargo::rerun-if-changed=build.rs");
}

#[cfg(feature = "openvdb")]
mod bridge {
    use std::env;
    use std::fs;
    use std::path::{Path, PathBuf};

    /// Major versions whose headers the bridge compiles against.
    const SUPPORTED: std::ops::RangeInclusive<u32> = 10..=13;
    /// OpenVDB stopped using Boost's headers with this version.
    const FIRST_WITHOUT_BOOST: u32 = 12;
    const VARIABLES: [&str; 3] = ["OPENVDB_ROOT", "OPENVDB_INCLUDE_DIR", "OPENVDB_LIB_DIR"];

    pub fn build() -> Result<(), String> {
        for file in ["build.rs", "cpp", "src/vdb/bridge.rs"] {
            println!("cargo::rerun-if-changed={file}");
        }
        for variable in VARIABLES {
            println!("cargo::rerun-if-env-changed={variable}");
        }
        let found = Installation::find()?;
        // Writes the headers that the C++ files include.
        let mut bridge = cxx_build::bridge("src/vdb/bridge.rs");
        let generated = PathBuf::from(env::var_os("OUT_DIR").unwrap_or_default()).join("cxxbridge/include");
        // Independent translation units (4, 5 and 22 s on a 2023 server core, the tools longest): compiled side by side. `-O3`
        // because some loops of OpenVDB's tools are instantiated here, and comparisons with them are to be fair.
        std::thread::scope(|scope| {
            let tools =
                [("cpp/reference.cc", "vdb_edit_reference"), ("cpp/reference_morph.cc", "vdb_edit_reference_morph")];
            let tools = tools.map(|(file, library)| {
                let (found, generated) = (&found, &generated);
                let task = scope.spawn(move || {
                    let mut build = cc::Build::new();
                    found.configure(&mut build).include(generated).opt_level(3).file(file);
                    build.cargo_metadata(false).compile(library);
                });
                (file, task)
            });
            found.configure(&mut bridge).opt_level(3).files([
                "cpp/archive.cc",
                "cpp/fingerprint.cc",
                "cpp/output.cc",
                "cpp/grid.cc",
                "cpp/chunks.cc",
                "cpp/vector.cc",
                "cpp/reference_io.cc",
            ]);
            bridge.cargo_metadata(false).compile("vdb_edit_bridge");
            tools.into_iter().try_for_each(|(file, task)| {
                task.join().map_err(|_| format!("the compiler failed on {file}, see above"))
            })
        })?;
        found.link();
        Ok(())
    }

    /// Where OpenVDB and what it needs were found.
    struct Installation {
        include: Vec<PathBuf>,
        /// The libraries to link: folder and name.
        lib: Vec<(PathBuf, String)>,
    }

    impl Installation {
        fn find() -> Result<Self, String> {
            let prefixes = prefixes();
            let include_dirs = search_dirs("OPENVDB_INCLUDE_DIR", &prefixes, &["include"]);
            let multiarch = format!("lib/{}", multiarch());
            let lib_dirs = search_dirs("OPENVDB_LIB_DIR", &prefixes, &[&multiarch, "lib64", "lib"]);

            let openvdb = locate(&include_dirs, "openvdb/version.h", "OpenVDB", "libopenvdb-dev")?;
            let version = fs::read_to_string(openvdb.join("openvdb/version.h"))
                .map_err(|e| format!("{}/openvdb/version.h cannot be read: {e}", openvdb.display()))?;
            let major = macro_value(&version, "OPENVDB_LIBRARY_MAJOR_VERSION_NUMBER")
                .ok_or_else(|| format!("{}/openvdb/version.h states no version", openvdb.display()))?;
            if !SUPPORTED.contains(&major) {
                return Err(format!(
                    "{} is OpenVDB {major}; versions {} to {} work. Set OPENVDB_ROOT to the prefix of such a version.",
                    openvdb.display(),
                    SUPPORTED.start(),
                    SUPPORTED.end()
                ));
            }
            let mut include = vec![openvdb];
            include.push(locate(&include_dirs, "tbb/global_control.h", "TBB", "libtbb-dev")?);
            let mut libraries = vec![("openvdb", "libopenvdb-dev"), ("tbb", "libtbb-dev")];
            if version.lines().any(|line| line.trim() == "#define OPENVDB_USE_IMATH_HALF") {
                include.push(locate(&include_dirs, "Imath/half.h", "Imath", "libimath-dev")?);
                // OpenVDB's headers use its table of half floats.
                libraries.push(("Imath", "libimath-dev"));
            }
            if major < FIRST_WITHOUT_BOOST {
                let what = format!("Boost, whose headers OpenVDB {major} includes");
                include.push(locate(&include_dirs, "boost/uuid/uuid.hpp", &what, "libboost-dev")?);
            }
            include.dedup();

            let lib = libraries.into_iter().map(|(name, package)| locate_library(&lib_dirs, name, package));
            let lib = lib.collect::<Result<_, _>>()?;
            Ok(Self { include, lib })
        }

        /// Sets language, warnings and include paths.
        fn configure<'b>(&self, build: &'b mut cc::Build) -> &'b mut cc::Build {
            build.cpp(true).std("c++17").include("cpp").warnings(true).extra_warnings(true);
            // Debug information of OpenVDB's templates is 15 times the size of the code and half of the compile time.
            build.debug(false);
            // As releases of OpenVDB are built: its assertions in inner loops would make comparisons unfair.
            build.define("NDEBUG", None);
            for dir in &self.include {
                // As system headers, whose warnings are not ours; the default path must not be named again.
                if dir != Path::new("/usr/include") {
                    build.flag(format!("-isystem{}", dir.display()));
                }
            }
            build
        }

        fn link(&self) {
            let out = env::var("OUT_DIR").unwrap_or_default();
            println!("cargo::rustc-link-search=native={out}");
            // The generated code calls into the reference, not the other way about, but that calls into the bridge.
            println!("cargo::rustc-link-lib=static=vdb_edit_bridge");
            println!("cargo::rustc-link-lib=static=vdb_edit_reference");
            println!("cargo::rustc-link-lib=static=vdb_edit_reference_morph");
            for (dir, library) in &self.lib {
                println!("cargo::rustc-link-search=native={}", dir.display());
                println!("cargo::rustc-link-lib={library}");
                if !dir.starts_with("/usr/lib") && !dir.starts_with("/lib") {
                    println!("cargo::rustc-link-arg=-Wl,-rpath,{}", dir.display());
                }
            }
            let cpp = if cfg!(target_os = "macos") { "c++" } else { "stdc++" };
            println!("cargo::rustc-link-lib={cpp}");
        }
    }

    fn prefixes() -> Vec<PathBuf> {
        let given = ["OPENVDB_ROOT", "CONDA_PREFIX"].into_iter().filter_map(env::var_os).map(PathBuf::from);
        given.chain(["/usr/local", "/usr", "/opt/homebrew", "/opt/local"].map(PathBuf::from)).collect()
    }

    /// `variable` first, then each prefix with each of `names` below it; only what exists.
    fn search_dirs(variable: &str, prefixes: &[PathBuf], names: &[&str]) -> Vec<PathBuf> {
        let below = prefixes.iter().flat_map(|prefix| names.iter().map(|name| prefix.join(name)));
        env::var_os(variable).map(PathBuf::from).into_iter().chain(below).filter(|dir| dir.is_dir()).collect()
    }

    /// Debian's name of the target in library paths.
    fn multiarch() -> String {
        let arch = env::var("CARGO_CFG_TARGET_ARCH").unwrap_or_default();
        format!("{arch}-linux-gnu")
    }

    fn locate(dirs: &[PathBuf], header: &str, what: &str, package: &str) -> Result<PathBuf, String> {
        let found = dirs.iter().find(|dir| dir.join(header).is_file());
        found.cloned().ok_or_else(|| missing(&format!("{what} ({header})"), dirs, package))
    }

    /// `lib<name>` or a versioned `lib<name>-<version>`: its folder, and its name for the linker.
    fn locate_library(dirs: &[PathBuf], name: &str, package: &str) -> Result<(PathBuf, String), String> {
        for dir in dirs {
            let files = fs::read_dir(dir).into_iter().flatten().flatten();
            let names = files.filter_map(|file| {
                let file = file.file_name().into_string().ok()?;
                let stem = [".so", ".dylib", ".a"].into_iter().find_map(|extension| file.strip_suffix(extension))?;
                let library = stem.strip_prefix("lib")?;
                let rest = library.strip_prefix(name)?;
                (rest.is_empty() || rest.starts_with('-')).then(|| library.to_string())
            });
            // The shortest: the plain name where there is one.
            if let Some(library) = names.min_by_key(|library| (library.len(), library.clone())) {
                return Ok((dir.clone(), library));
            }
        }
        Err(missing(&format!("the library lib{name}"), dirs, package))
    }

    fn missing(what: &str, dirs: &[PathBuf], package: &str) -> String {
        let searched: Vec<_> = dirs.iter().map(|dir| dir.display().to_string()).collect();
        format!(
            "{what} was not found in {}.\nOn Debian or Ubuntu: apt-get install {package}\nElsewhere: install it and set \
             OPENVDB_ROOT to its prefix, or OPENVDB_INCLUDE_DIR and OPENVDB_LIB_DIR.",
            if searched.is_empty() { "any usual place".into() } else { searched.join(", ") }
        )
    }

    /// The number that `#define name number` gives.
    fn macro_value(text: &str, name: &str) -> Option<u32> {
        text.lines().find_map(|line| {
            let mut words = line.split_whitespace();
            (words.next() == Some("#define") && words.next() == Some(name)).then(|| words.next()?.parse().ok())?
        })
    }
}
