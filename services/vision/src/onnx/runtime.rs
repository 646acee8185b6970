//! ONNX Runtime, found at run time.

use crate::VisionError;
use ort::AsPointer;
use ort::environment::Environment;
use ort::ep::ExecutionProvider;
use segwild_files::lock;
use std::path::{Path, PathBuf};
use std::sync::Mutex;

/// The loaded runtime. There is one per process: the first one found serves until the end.
#[derive(Clone)]
pub struct Runtime {
    pub(super) environment: Environment,
    library: PathBuf,
}

/// Default of the MiB that networks may hold: the base encoders of the SAM family take about 3000, the largest one twice as much.
pub(crate) const MEMORY_MIB: u32 = 4096;

/// Whether this program can load libraries. One that is linked statically to musl cannot: there `dlopen` always fails.
const LOADS_LIBRARIES: bool = !cfg!(all(target_env = "musl", target_feature = "crt-static"));

static LOADED: Mutex<Option<Runtime>> = Mutex::new(None);

impl Runtime {
    /// Finds and loads the library: at `path` if it is not empty, else at `$ORT_DYLIB_PATH` if that is set, else in the
    /// system's library folders, else inside Python's `onnxruntime` package. What is there but cannot be used (not a
    /// library, too old) is named in the error, with what to do.
    pub fn find(path: &str) -> Result<Runtime, VisionError> {
        Runtime::find_within(path, MEMORY_MIB)
    }

    /// As [`Runtime::find`]; all networks together may hold that many MiB on the CPU. The first call that loads the runtime sets
    /// the limit.
    pub(crate) fn find_within(path: &str, memory_mib: u32) -> Result<Runtime, VisionError> {
        if !LOADS_LIBRARIES {
            return Err(VisionError::Model(
                "ONNX Runtime cannot be used: this program is linked statically and loads no library. Take the \
                 program for linux-gnu, or let a vision service compute the networks (`--vision-service`)"
                    .into(),
            ));
        }
        let mut loaded = lock(&LOADED);
        if let Some(runtime) = &*loaded {
            return Ok(runtime.clone());
        }
        let mut refused = Vec::new();
        for library in candidates(path) {
            match load(&library, memory_mib as usize * (1 << 20)) {
                Ok(environment) => {
                    tracing::info!(library = %library.display(), "ONNX Runtime loaded");
                    return Ok(loaded.insert(Runtime { environment, library }).clone());
                }
                Err(error) => refused.push(error.to_string()),
            }
        }
        let tried = if refused.is_empty() { "none was found".to_owned() } else { refused.join("; ") };
        Err(VisionError::Model(format!(
            "ONNX Runtime cannot be used: {tried}. Install it (for instance `pip install onnxruntime`), or set `onnxruntime` \
             or ORT_DYLIB_PATH to libonnxruntime.so of version 1.{} or later",
            ort::MINOR_VERSION
        )))
    }

    /// The library's file.
    pub fn library(&self) -> &Path {
        &self.library
    }

    /// Whether the library was built with CUDA. Whether CUDA works here shows when a network is loaded.
    pub fn has_cuda(&self) -> bool {
        ort::ep::CUDA::is_available().unwrap_or(false)
    }
}

/// Why a library cannot be used as ONNX Runtime.
#[derive(Debug, thiserror::Error)]
enum LibraryError {
    /// It cannot be loaded, or it is too old.
    #[error("{0}")]
    Load(ort::LoadDynamicError),
    #[error("{} does not start: {reason}", library.display())]
    Start { library: PathBuf, reason: ort::Error },
    #[error("{} takes no limit of memory: {reason}", library.display())]
    Memory { library: PathBuf, reason: ort::Error },
    /// It made its binding panic.
    #[error("{} is not a usable ONNX Runtime", .0.display())]
    Unusable(PathBuf),
}

/// Registers one allocator with a limit; networks use it instead of unlimited ones of their own. An allocation over the limit
/// is refused before its memory is touched.
fn limit_memory(environment: &Environment, bytes: usize) -> ort::Result<()> {
    let api = ort::api();
    let failed = |status: ort::sys::OrtStatusPtr| {
        // SAFETY: the status comes from the call just made and is handed over.
        unsafe { ort::Error::result_from_status(status) }
    };
    let (mut info, mut arena) = (std::ptr::null_mut(), std::ptr::null_mut());
    // As much as is requested and no more, the runtime's usual chunks otherwise.
    let (as_requested, usual) = (1, -1);
    // SAFETY: both calls only write the pointers they are given; what they made is released below, on every way out.
    // The runtime copies what it needs of both when it registers the allocator.
    unsafe {
        let kind = ort::sys::OrtAllocatorType::OrtArenaAllocator;
        let made =
            failed((api.CreateCpuMemoryInfo)(kind, ort::sys::OrtMemType::OrtMemTypeDefault, &mut info))
                .and_then(|()| failed((api.CreateArenaCfg)(bytes, as_requested, usual, usual, &mut arena)))
                .and_then(|()| {
                    let environment = environment.ptr().cast_mut();
                    failed((api.CreateAndRegisterAllocator)(environment, info, arena))
                });
        if !arena.is_null() {
            (api.ReleaseArenaCfg)(arena);
        }
        if !info.is_null() {
            (api.ReleaseMemoryInfo)(info);
        }
        made
    }
}

/// Loads one library. Every failure, a panic included, becomes an error.
fn load(library: &Path, memory: usize) -> Result<Environment, LibraryError> {
    let named = || library.to_owned();
    let attempt = || -> Result<Environment, LibraryError> {
        let builder = ort::init_from(library).map_err(LibraryError::Load)?;
        let environment = builder
            .with_name("segwild")
            .with_telemetry(false)
            .build()
            .map_err(|reason| LibraryError::Start { library: named(), reason })?;
        limit_memory(&environment, memory)
            .map_err(|reason| LibraryError::Memory { library: named(), reason })?;
        Ok(environment)
    };
    // ort asserts a few things about the library instead of returning an error.
    std::panic::catch_unwind(attempt).unwrap_or_else(|_| Err(LibraryError::Unusable(named())))
}

/// Library files to try, best first.
fn candidates(path: &str) -> Vec<PathBuf> {
    let absolute = |p: &str| std::path::absolute(p).unwrap_or_else(|_| PathBuf::from(p));
    if !path.is_empty() {
        return vec![absolute(path)];
    }
    if let Ok(named) = std::env::var("ORT_DYLIB_PATH")
        && !named.is_empty()
    {
        return vec![absolute(&named)];
    }
    let mut found = Vec::new();
    let listed = |name: &str| -> Vec<PathBuf> {
        std::env::var_os(name).map(|v| std::env::split_paths(&v).collect()).unwrap_or_default()
    };
    let mut folders = listed("LD_LIBRARY_PATH");
    folders.extend(listed("DYLD_LIBRARY_PATH"));
    folders.extend(
        [
            "/usr/local/lib",
            "/usr/lib",
            "/usr/lib64",
            "/usr/lib/x86_64-linux-gnu",
            "/usr/lib/aarch64-linux-gnu",
            "/opt/onnxruntime/lib",
            "/opt/homebrew/lib",
        ]
        .map(PathBuf::from),
    );
    folders.iter().for_each(|f| libraries_in(f, &mut found));
    let mut prefixes: Vec<PathBuf> =
        ["VIRTUAL_ENV", "CONDA_PREFIX"].iter().filter_map(std::env::var_os).map(PathBuf::from).collect();
    if let Some(home) = std::env::var_os("HOME") {
        prefixes.push(Path::new(&home).join(".local"));
    }
    prefixes.extend(["/usr/local", "/usr"].map(PathBuf::from));
    prefixes.extend(entries(Path::new("/opt")));
    for prefix in prefixes {
        for python in entries(&prefix.join("lib")) {
            if python.file_name().is_some_and(|n| n.to_string_lossy().starts_with("python3")) {
                for packages in ["site-packages", "dist-packages"] {
                    libraries_in(&python.join(packages).join("onnxruntime/capi"), &mut found);
                }
            }
        }
        libraries_in(&prefix.join("Lib/site-packages/onnxruntime/capi"), &mut found);
    }
    if found.is_empty() {
        // The last resort costs a process: where Python itself looks for packages.
        let python = std::process::Command::new("python3")
            .args(["-c", "import sys; print('\\n'.join(sys.path))"])
            .output();
        if let Ok(output) = python {
            for line in String::from_utf8_lossy(&output.stdout).lines().filter(|l| !l.is_empty()) {
                libraries_in(&Path::new(line).join("onnxruntime/capi"), &mut found);
            }
        }
    }
    found
}

/// What a folder holds, sorted; nothing if it cannot be read.
fn entries(folder: &Path) -> Vec<PathBuf> {
    let mut all: Vec<PathBuf> = std::fs::read_dir(folder)
        .map(|d| d.filter_map(|e| e.ok().map(|e| e.path())).collect())
        .unwrap_or_default();
    all.sort();
    all
}

/// Adds a folder's ONNX Runtime libraries, the newest name first.
fn libraries_in(folder: &Path, found: &mut Vec<PathBuf>) {
    let is_library = |p: &PathBuf| {
        p.file_name().map(|n| n.to_string_lossy()).is_some_and(|n| {
            n.starts_with("libonnxruntime.so")
                || (n.starts_with("libonnxruntime.") && n.ends_with(".dylib"))
                || n == "onnxruntime.dll"
        })
    };
    found.extend(entries(folder).into_iter().filter(is_library).rev());
}
