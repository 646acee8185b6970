//! ONNX Runtime, found at run time, and networks that take one photo.

use crate::VisionError;
use ort::environment::Environment;
use ort::session::Session;
use ort::value::{Tensor, TensorElementType};
use segwild_scene::Image;
use std::path::{Path, PathBuf};
use std::sync::{Mutex, PoisonError};

/// The loaded runtime. There is one per process: the first one found serves until the end.
#[derive(Clone)]
pub struct Runtime {
    environment: Environment,
    library: PathBuf,
}

static LOADED: Mutex<Option<Runtime>> = Mutex::new(None);

impl Runtime {
    /// Finds and loads the library: at `path` if it is not empty, else at `$ORT_DYLIB_PATH` if that is set, else in the
    /// system's library folders, else inside Python's `onnxruntime` package. What is there but cannot be used (not a
    /// library, too old) is named in the error, with what to do.
    pub fn find(path: &str) -> Result<Runtime, VisionError> {
        let mut loaded = LOADED.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some(runtime) = &*loaded {
            return Ok(runtime.clone());
        }
        let mut refused = Vec::new();
        for library in candidates(path) {
            match load(&library) {
                Ok(environment) => {
                    tracing::info!(library = %library.display(), "ONNX Runtime loaded");
                    return Ok(loaded.insert(Runtime { environment, library }).clone());
                }
                Err(reason) => refused.push(reason),
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
}

/// Loads one library. Whatever goes wrong inside becomes a sentence.
fn load(library: &Path) -> Result<Environment, String> {
    let attempt = || -> Result<Environment, String> {
        let builder = ort::init_from(library).map_err(|e| e.to_string())?;
        builder
            .with_name("segwild")
            .with_telemetry(false)
            .build()
            .map_err(|e| format!("{} does not start: {e}", library.display()))
    };
    // ort asserts a few things about the library instead of returning an error.
    std::panic::catch_unwind(attempt)
        .unwrap_or_else(|_| Err(format!("{} is not a usable ONNX Runtime", library.display())))
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

/// A network of one photo in, one map out.
pub(crate) struct Network {
    session: Mutex<Session>,
    input: String,
    output: String,
    /// Height and width the photo must have; `None` where the file leaves it open.
    pub size: [Option<usize>; 2],
    /// Channels of the answer, where the file says.
    pub answers: Option<usize>,
    name: String,
    key: String,
}

impl Network {
    /// Loads a file and checks that it takes `[1, 3, h, w]` and answers `[1, c, h, w]`.
    pub fn load(runtime: &Runtime, path: &Path, threads: u32) -> Result<Network, VisionError> {
        let name = path.display().to_string();
        let wrong = |what: String| VisionError::Model(format!("{name}: {what}"));
        let bytes = std::fs::read(path).map_err(|e| wrong(format!("cannot be read: {e}")))?;
        let key = blake3::hash(&bytes).to_hex()[..16].to_owned();
        let build = || -> Result<Session, String> {
            let text = |e: ort::Error<ort::session::builder::SessionBuilder>| e.to_string();
            Session::builder(&runtime.environment)
                .map_err(|e| e.to_string())?
                .with_intra_threads(threads.max(1) as usize)
                .map_err(text)?
                .with_inter_threads(1)
                .map_err(text)?
                .with_deterministic_compute(true)
                .map_err(text)?
                .with_log_level(ort::logging::LogLevel::Error)
                .map_err(text)?
                .commit_from_memory(&bytes)
                .map_err(|e| e.to_string())
        };
        let session = build().map_err(|e| wrong(format!("is no network that ONNX Runtime can load: {e}")))?;
        let [input] = session.inputs() else {
            let names: Vec<&str> = session.inputs().iter().map(|i| i.name()).collect();
            return Err(wrong(format!(
                "takes {} inputs ({}); one photo was expected",
                names.len(),
                names.join(", ")
            )));
        };
        let shape: Vec<i64> = input.dtype().tensor_shape().map(|s| s.to_vec()).unwrap_or_default();
        if input.dtype().tensor_type() != Some(TensorElementType::Float32)
            || shape.len() != 4
            || !matches!(shape[0], 1 | -1)
            || !matches!(shape[1], 3 | -1)
        {
            return Err(wrong(format!(
                "its input `{}` is {}; float32 [1, 3, h, w] was expected",
                input.name(),
                input.dtype()
            )));
        }
        let Some(output) = session.outputs().first() else { return Err(wrong("has no output".into())) };
        let answer: Vec<i64> = output.dtype().tensor_shape().map(|s| s.to_vec()).unwrap_or_default();
        if output.dtype().tensor_type() != Some(TensorElementType::Float32) || answer.len() != 4 {
            return Err(wrong(format!(
                "its output `{}` is {}; float32 [1, c, h, w] was expected",
                output.name(),
                output.dtype()
            )));
        }
        let open = |n: i64| usize::try_from(n).ok().filter(|&n| n > 0);
        let (input, output) = (input.name().to_owned(), output.name().to_owned());
        Ok(Network {
            size: [open(shape[2]), open(shape[3])],
            answers: open(answer[1]),
            session: Mutex::new(session),
            input,
            output,
            name,
            key,
        })
    }

    /// The file's name, for messages.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Hash of the file (16 hexadecimal digits).
    pub fn key(&self) -> &str {
        &self.key
    }

    /// Runs the network on three planes that already have its size and value range.
    pub fn run(&self, planes: Image) -> Result<Image, VisionError> {
        let wrong = |what: String| VisionError::Model(format!("{}: {what}", self.name));
        let (h, w) = (planes.height, planes.width);
        let tensor = Tensor::from_array(([1usize, 3, h, w], planes.data))
            .map_err(|e| wrong(format!("takes no photo: {e}")))?;
        let mut session = self.session.lock().unwrap_or_else(PoisonError::into_inner);
        let outputs = session
            .run(ort::inputs! { self.input.as_str() => tensor })
            .map_err(|e| wrong(format!("fails on a photo of {w} x {h}: {e}")))?;
        let value = outputs.get(&self.output).ok_or_else(|| wrong(format!("gave no `{}`", self.output)))?;
        let (shape, data) =
            value.try_extract_tensor::<f32>().map_err(|e| wrong(format!("gave no numbers: {e}")))?;
        let size: Vec<usize> = shape.iter().map(|&n| usize::try_from(n).unwrap_or(0)).collect();
        match size[..] {
            [1, channels, height, width] if channels * height * width == data.len() && !data.is_empty() => {
                Ok(Image { width, height, channels, data: data.to_vec() })
            }
            _ => Err(wrong(format!("answered {size:?}; [1, c, h, w] was expected"))),
        }
    }
}
