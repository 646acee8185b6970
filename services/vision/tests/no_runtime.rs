//! A library that is no ONNX Runtime, in a process of its own, since the first runtime found serves a whole process.

use segwild_vision::Runtime;

#[test]
fn a_library_that_is_none_is_an_error() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("libonnxruntime.so");
    std::fs::write(&file, b"not a library").unwrap();
    let error = Runtime::find(&file.display().to_string()).map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("libonnxruntime.so") && error.contains("pip install onnxruntime"), "{error}");
    let error = Runtime::find("/no/such/libonnxruntime.so").map(|_| ()).unwrap_err().to_string();
    assert!(error.contains("/no/such/"), "{error}");
    // A real library, but of something else.
    for other in ["/lib/x86_64-linux-gnu/libm.so.6", "/usr/lib/libSystem.dylib"] {
        if std::path::Path::new(other).exists() {
            let error = Runtime::find(other).map(|_| ()).unwrap_err().to_string();
            assert!(error.contains("OrtGetApiBase"), "{error}");
        }
    }
}
