//! The weights of LPIPS, which a user names by a file.

use crate::{RunError, Settings};
use segwild_flow::files;
use segwild_trainer::Lpips;
use std::path::Path;
use std::sync::Arc;

/// Most bytes of the file: VGG-16's weights take 59 MB, and twice that as F32 with all that the package adds.
const MOST: u64 = 256 << 20;

/// The perceptual distance, and the hash of the file that its weights come from.
#[derive(Clone, Debug)]
pub struct LpipsFile {
    /// The distance.
    pub lpips: Arc<Lpips>,
    /// Hash of the file.
    pub digest: String,
}

impl LpipsFile {
    /// Reads the file that the settings name, if they name one.
    ///
    /// # Errors
    /// When it cannot be read, or holds no weights of LPIPS.
    pub fn of(settings: &Settings) -> Result<Option<LpipsFile>, RunError> {
        let file = &settings.run.lpips_weights;
        if file.is_empty() {
            return Ok(None);
        }
        let refused = |reason: String| RunError::Input(format!("--lpips-weights {file}: {reason}"));
        let bytes = files::read_within(Path::new(file), MOST).map_err(|e| refused(e.to_string()))?;
        let lpips = Lpips::parse(&bytes).map_err(|e| refused(e.to_string()))?;
        let digest = blake3::hash(&bytes).to_hex().to_string();
        Ok(Some(LpipsFile { lpips: Arc::new(lpips), digest }))
    }

    /// Refuses a loss with LPIPS where no file of weights is named.
    ///
    /// # Errors
    /// In words.
    pub fn needed(settings: &Settings) -> Result<(), RunError> {
        let train = &settings.train;
        if train.lambda_lpips == 0.0 || !settings.run.lpips_weights.is_empty() {
            return Ok(());
        }
        Err(RunError::Request(format!(
            "--lambda-lpips {} needs the weights of LPIPS: name their file by --lpips-weights (docs/guide/research.md says \
             how to make it), or leave it 0",
            train.lambda_lpips
        )))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_loss_with_lpips_is_refused_without_its_weights_and_a_wrong_file_by_its_name() {
        let mut settings = Settings::default();
        assert!(LpipsFile::needed(&settings).is_ok() && LpipsFile::of(&settings).unwrap().is_none());
        settings.train.lambda_lpips = 0.005;
        let message = LpipsFile::needed(&settings).unwrap_err().to_string();
        assert!(message.contains("--lambda-lpips 0.005") && message.contains("--lpips-weights"), "{message}");
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("lpips_vgg.safetensors");
        settings.run.lpips_weights = file.display().to_string();
        assert!(LpipsFile::needed(&settings).is_ok());
        let refused = || LpipsFile::of(&settings).unwrap_err().to_string();
        assert!(refused().contains("lpips_vgg.safetensors"), "{}", refused());
        std::fs::write(&file, b"PK\x03\x04 a file that torch.save wrote").unwrap();
        assert!(refused().contains("lpips_vgg.safetensors: it is no .safetensors file"), "{}", refused());
        std::fs::remove_file(&file).unwrap();
        std::fs::create_dir(&file).unwrap();
        assert!(refused().contains("it is a folder"), "{}", refused());
    }
}
