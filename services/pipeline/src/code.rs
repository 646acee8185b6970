//! Where the code of a run's networks is: whoever runs the program says it, a run folder never does.
//!
//! A network is executed by a library that is loaded. A run folder may have come from somebody else, so that what its
//! `segwild.toml` says of both ([`VisionSettings::CODE`]) is information and no more. `RUN/networks.json` says which network
//! files a run was made with: by their hashes a later command tells whether it was given the same.

use crate::region_cache::InCache;
use crate::{RunError, RunFolder, Settings};
use segwild_vision::{NetworkFile, Providers, VisionSettings};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

/// Where the record is in the run folder.
const RECORD: &str = "networks.json";
/// The environment's word for the folder of models; the library has `ORT_DYLIB_PATH`.
const MODELS: &str = "SEGWILD_MODELS";

/// What is said of code now: by flags, else by the environment.
#[derive(Clone, Debug, Default)]
pub struct Code {
    flags: BTreeMap<&'static str, String>,
    models: Option<String>,
}

impl Code {
    /// From a command's flags, of which the others are passed over, and from the environment.
    pub fn given(flags: &[(String, String)]) -> Code {
        let said = |name: &&'static str| {
            let value = flags.iter().rev().find(|(flag, _)| flag == name).map(|(_, value)| value.clone());
            value.map(|value| (*name, value))
        };
        let models = std::env::var(MODELS).ok().filter(|models| !models.is_empty());
        Code { flags: VisionSettings::CODE.iter().filter_map(said).collect(), models }
    }

    /// As settings say it that do not come from a run folder.
    pub fn of(settings: &VisionSettings) -> Code {
        let VisionSettings { models, transient_network, onnxruntime, .. } = settings;
        let said = [models, transient_network, onnxruntime].map(String::clone);
        Code { flags: VisionSettings::CODE.into_iter().zip(said).collect(), models: None }
    }

    /// Puts it into settings: flags in the place of what is there, the environment where nothing is said.
    pub fn tell(&self, settings: &mut VisionSettings) {
        let VisionSettings { models, transient_network, onnxruntime, .. } = settings;
        for (name, place) in VisionSettings::CODE.iter().zip([&mut *models, transient_network, onnxruntime]) {
            if let Some(value) = self.flags.get(name) {
                place.clone_from(value);
            }
        }
        if let Some(named) =
            self.models.as_ref().filter(|_| !self.flags.contains_key("models") && models.is_empty())
        {
            models.clone_from(named);
        }
    }

    /// Refuses to go on with a run that networks were used for when nothing is said of where they are now. A flag that is
    /// empty says that there are none.
    ///
    /// # Errors
    /// Says which file is missing, its hash, and which flag names it.
    pub fn names_networks_of(&self, folder: &RunFolder, settings: &VisionSettings) -> Result<(), RunError> {
        self.names(&recorded(folder), settings)
    }

    fn names(&self, before: &[NetworkFile], settings: &VisionSettings) -> Result<(), RunError> {
        for (setting, value) in
            [("models", &settings.models), ("transient_network", &settings.transient_network)]
        {
            let of_setting = || before.iter().filter(|network| network.setting == setting);
            let Some(first) = of_setting().next().filter(|_| value.is_empty()) else { continue };
            if !self.flags.contains_key(setting) {
                return Err(RunError::Request(untold(setting, first, of_setting().count() - 1)));
            }
        }
        Ok(())
    }
}

/// What is missing, and how to name it.
fn untold(setting: &str, first: &NetworkFile, others: usize) -> String {
    let more = if others > 0 { format!(" and {others} more") } else { String::new() };
    let flag = setting.replace('_', "-");
    let (what, environment) = match setting {
        "models" => ("FOLDER", format!(", or set {MODELS}")),
        _ => ("FILE", String::new()),
    };
    format!(
        "this run was made with the network {}{more}, and a run folder is never asked where code is: give --{flag} {what} \
         (the run says {}){environment}; --{flag} '' goes on without",
        words(first),
        match setting {
            "models" if !first.hash.is_empty() => first.file.parent().unwrap_or(&first.file).display(),
            _ => first.file.display(),
        }
    )
}

/// A network's name and hash.
fn words(network: &NetworkFile) -> String {
    let name = network.file.file_name().map(|n| n.to_string_lossy().into_owned()).unwrap_or_default();
    match network.hash.as_str() {
        "" => format!("files of {}", network.file.display()),
        hash => format!("{name} (BLAKE3 {hash}..)"),
    }
}

/// The network files that a run was made with; of a run that was made before they were written down, what its settings name.
pub(crate) fn recorded(folder: &RunFolder) -> Vec<NetworkFile> {
    if let Ok(networks) = folder.read_json::<Vec<NetworkFile>>(RECORD) {
        return networks;
    }
    let Ok(settings) = Settings::layered(Some(&folder.settings_file()), &[]) else { return Vec::new() };
    let VisionSettings { models, transient_network, .. } = settings.vision;
    let named = [("models", models), ("transient_network", transient_network)];
    let named = named.into_iter().filter(|(_, file)| !file.is_empty());
    named
        .map(|(setting, file)| NetworkFile {
            setting: setting.into(),
            file: PathBuf::from(file),
            hash: String::new(),
        })
        .collect()
}

/// Writes down which networks a run is made with; returns how they differ from those of before, a sentence each.
pub(crate) fn record(folder: &RunFolder, networks: &[NetworkFile]) -> Result<Vec<String>, RunError> {
    let known = folder.read_json::<Vec<NetworkFile>>(RECORD).ok();
    folder.write_json(RECORD, &networks)?;
    Ok(changes(&known.unwrap_or_default(), networks))
}

/// How networks differ from those of before, a sentence each. Where nothing was written down nothing differs.
pub(crate) fn changes(before: &[NetworkFile], now: &[NetworkFile]) -> Vec<String> {
    let mut changes = Vec::new();
    for old in before.iter().filter(|old| !old.hash.is_empty()) {
        let same_name = |new: &&NetworkFile| new.file.file_name() == old.file.file_name();
        match now.iter().find(same_name) {
            Some(new) if new.hash == old.hash => {}
            Some(new) => changes.push(format!(
                "{} is not the network that the run was made with: its BLAKE3 begins with {}, that of the run's with {}",
                new.file.display(),
                new.hash,
                old.hash
            )),
            None => changes.push(format!("the network {} that the run was made with is not used", words(old))),
        }
    }
    changes
}

/// The providers that answer clicks on a run: with its settings, and with networks where they are said to be now.
///
/// # Errors
/// When the run was made with networks and nothing is said of where they are, or what is named cannot be used.
pub fn providers_for(folder: &RunFolder, code: &Code) -> Result<Providers, RunError> {
    let mut settings = folder.settings()?;
    code.tell(&mut settings.vision);
    // A click asks nobody who is a transient.
    settings.vision.transient_network.clear();
    let networks = of_clicks(recorded(folder));
    code.names(&networks, &settings.vision)?;
    Ok(Providers::keeping(&sight(&settings), Some(Arc::new(InCache(folder.cache()?))))?)
}

/// Those networks that clicks make use of.
pub(crate) fn of_clicks(mut networks: Vec<NetworkFile>) -> Vec<NetworkFile> {
    networks.retain(|network| network.setting == "models");
    networks
}

/// How photos are looked at for a click: what the caches of the training and of the feature field may take is free for their
/// analyses.
fn sight(settings: &Settings) -> VisionSettings {
    let mut vision = settings.vision.clone();
    if settings.run.memory_budget == 0 {
        let free = (settings.train.photo_cache_mib as u32).max(settings.features.feature_memory);
        vision.vision_memory = vision.vision_memory.saturating_add(free);
    }
    vision
}

#[cfg(test)]
mod tests {
    use super::*;

    fn network(setting: &str, file: &str, hash: &str) -> NetworkFile {
        NetworkFile { setting: setting.into(), file: file.into(), hash: hash.into() }
    }

    #[test]
    fn a_run_made_with_networks_says_what_is_missing_and_which_flag_names_it() {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(dir.path()).unwrap();
        let networks = [
            network("models", "/nets/sam_encoder.onnx", "0123456789abcdef"),
            network("models", "/nets/sam_decoder.onnx", "1123456789abcdef"),
        ];
        assert!(record(&folder, &networks).unwrap().is_empty());
        let nothing = Code::default();
        let said = nothing.names_networks_of(&folder, &VisionSettings::default()).unwrap_err().to_string();
        for word in ["sam_encoder.onnx", "0123456789abcdef", "1 more", "--models FOLDER", "/nets)", MODELS] {
            assert!(said.contains(word), "{word}: {said}");
        }
        let without = Code { flags: [("models", String::new())].into(), ..Code::default() };
        without.names_networks_of(&folder, &VisionSettings::default()).unwrap();
        let mut named = VisionSettings::default();
        Code { models: Some("/elsewhere".into()), ..Code::default() }.tell(&mut named);
        assert_eq!(named.models, "/elsewhere");
        nothing.names_networks_of(&folder, &named).unwrap();
    }

    #[test]
    fn a_network_with_other_bytes_under_the_same_name_is_said() {
        let before = [network("models", "/a/sky.onnx", "01"), network("models", "/a/edges.onnx", "02")];
        let same = [network("models", "/b/sky.onnx", "01"), network("models", "/b/edges.onnx", "02")];
        assert!(changes(&before, &same).is_empty());
        let said = changes(&before, &[network("models", "/b/sky.onnx", "03")]).join("\n");
        assert!(
            said.contains("/b/sky.onnx is not the network") && said.contains("edges.onnx (BLAKE3 02..)"),
            "{said}"
        );
    }

    #[test]
    fn a_flag_says_where_networks_are_before_the_environment_and_that_before_nothing() {
        let flags = [("models".to_owned(), "/flag".to_owned()), ("tau".to_owned(), "1".to_owned())];
        let code = Code { models: Some("/environment".into()), ..Code::given(&flags) };
        let mut settings = VisionSettings { models: "/file".into(), ..VisionSettings::default() };
        code.tell(&mut settings);
        assert_eq!(settings.models, "/flag");
        let code = Code { models: Some("/environment".into()), ..Code::default() };
        settings.models = "/file".into();
        code.tell(&mut settings);
        assert_eq!(settings.models, "/file", "a settings file of the user's own");
    }

    #[test]
    fn every_setting_that_names_a_file_is_known_for_code_or_for_data() {
        use segwild_scene::settings::Group;
        // Whoever adds a setting of free text decides here what it may be taken from.
        let data = ["sam"];
        for field in VisionSettings::FIELDS.iter().filter(|field| field.kind == "TEXT") {
            assert!(
                VisionSettings::CODE.contains(&field.name) || data.contains(&field.name),
                "{}",
                field.name
            );
        }
    }
}
