//! Where a run's network files and their library are: the user names them, a run folder never does.
//!
//! A network is executed by a library that is loaded. A run folder may have come from somebody else, so that the paths
//! in its `segwild.toml` ([`VisionSettings::CODE`]) are shown and never loaded. `RUN/networks.json` records which
//! network files a run was made with; a later command compares their hashes with those of the files that it is given.

use crate::artifacts::region_cache::InCache;
use crate::{RunError, RunFolder, Settings};
use segwild_vision::{NetworkFile, Providers, VisionSettings};
use std::collections::BTreeMap;
use std::path::PathBuf;
use std::sync::Arc;

/// Where the record is in the run folder.
const RECORD: &str = "networks.json";
/// The environment variables for settings of [`VisionSettings::CODE`]; that for the library is `ORT_DYLIB_PATH`.
const VARIABLES: [(&str, &str); 4] = [
    ("models", MODELS),
    ("vision_service", "SEGWILD_VISION_SERVICE"),
    ("vision_token_file", "SEGWILD_VISION_TOKEN_FILE"),
    ("vision_certificates", "SEGWILD_VISION_CERTIFICATES"),
];
const MODELS: &str = "SEGWILD_MODELS";

/// The paths of networks and their library as given now: by flags, else by the environment.
#[derive(Clone, Debug, Default)]
pub struct Code {
    flags: BTreeMap<&'static str, String>,
    environment: BTreeMap<&'static str, String>,
}

impl Code {
    /// Takes them from a command's flags and from the environment. Other flags are passed over.
    pub fn given(flags: &[(String, String)]) -> Code {
        let given = |name: &&'static str| {
            let value = flags.iter().rev().find(|(flag, _)| flag == name).map(|(_, value)| value.clone());
            value.map(|value| (*name, value))
        };
        let variable = |(name, variable): &(&'static str, &str)| {
            let value = std::env::var(variable).ok().filter(|value| !value.is_empty())?;
            Some((*name, value))
        };
        Code {
            flags: VisionSettings::CODE.iter().filter_map(given).collect(),
            environment: VARIABLES.iter().filter_map(variable).collect(),
        }
    }

    /// Takes them from settings that do not come from a run folder.
    pub fn of(settings: &VisionSettings) -> Code {
        let mut settings = settings.clone();
        let values = settings.code_mut().map(std::mem::take);
        Code { flags: VisionSettings::CODE.into_iter().zip(values).collect(), environment: BTreeMap::new() }
    }

    /// The same as environment variables, for a process that is started.
    pub fn variables(&self) -> impl Iterator<Item = (&'static str, &str)> {
        VARIABLES.iter().filter_map(|(name, variable)| Some((*variable, self.value(name)?)))
    }

    /// What is given for a setting.
    fn value(&self, name: &str) -> Option<&str> {
        self.flags.get(name).or_else(|| self.environment.get(name)).map(String::as_str)
    }

    /// Writes the paths into settings. Flags replace what is there; the environment fills what is empty.
    pub fn tell(&self, settings: &mut VisionSettings) {
        for (name, setting) in VisionSettings::CODE.iter().zip(settings.code_mut()) {
            let given = self.flags.get(name);
            if let Some(value) = given.or_else(|| self.environment.get(name).filter(|_| setting.is_empty())) {
                setting.clone_from(value);
            }
        }
    }

    /// Checks that the networks of a run are given again before the run continues. An empty flag means that there are
    /// none.
    ///
    /// # Errors
    /// Names the network file that is not given, its hash, and the flag for it.
    pub fn names_networks_of(&self, folder: &RunFolder, settings: &VisionSettings) -> Result<(), RunError> {
        self.names(&recorded(folder), settings)
    }

    fn names(&self, before: &[NetworkFile], settings: &VisionSettings) -> Result<(), RunError> {
        for (setting, value) in [
            ("models", &settings.models),
            ("transient_network", &settings.transient_network),
            ("vision_service", &settings.vision_service),
        ] {
            let of_setting = || before.iter().filter(|network| network.setting == setting);
            let Some(first) = of_setting().next().filter(|_| value.is_empty()) else { continue };
            if !self.flags.contains_key(setting) {
                return Err(RunError::Request(not_given(setting, first, of_setting().count() - 1)));
            }
        }
        Ok(())
    }
}

/// The message about a network that is not given, with the flag that names it.
fn not_given(setting: &str, first: &NetworkFile, others: usize) -> String {
    if setting == "vision_service" {
        return format!(
            "this run was made with a vision service, and photos are never sent to where a run folder says: give --vision-service \
             grpc://HOST:PORT (the run says {}); --vision-service '' goes on without",
            first.file.display()
        );
    }
    let more = if others > 0 { format!(" and {others} more") } else { String::new() };
    let flag = setting.replace('_', "-");
    let (what, environment) = match setting {
        "models" => ("FOLDER", format!(", or set {MODELS}")),
        _ => ("FILE", String::new()),
    };
    format!(
        "this run was made with the network {}{more}, and code is never loaded from where a run folder says: give --{flag} {what} \
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

/// The network files that a run was made with. Runs of earlier versions did not record them: their settings name them.
pub(crate) fn recorded(folder: &RunFolder) -> Vec<NetworkFile> {
    if let Ok(networks) = folder.read_json::<Vec<NetworkFile>>(RECORD) {
        return networks;
    }
    let Ok(settings) = Settings::recorded_with_code(&folder.settings_file()) else { return Vec::new() };
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

/// Records which networks a run is made with. Returns how they differ from those recorded before, a sentence each.
pub(crate) fn record(folder: &RunFolder, networks: &[NetworkFile]) -> Result<Vec<String>, RunError> {
    let known = folder.read_json::<Vec<NetworkFile>>(RECORD).ok();
    folder.write_json(RECORD, &networks)?;
    Ok(changes(&known.unwrap_or_default(), networks))
}

/// How networks differ from those recorded before, a sentence each. Without a record nothing differs.
pub(crate) fn changes(before: &[NetworkFile], now: &[NetworkFile]) -> Vec<String> {
    let mut changes = Vec::new();
    for old in before.iter().filter(|old| !old.hash.is_empty()) {
        let same_name = |new: &&NetworkFile| match old.setting.as_str() {
            // The same models may be served elsewhere today.
            "vision_service" => new.setting == old.setting,
            _ => new.file.file_name() == old.file.file_name(),
        };
        match now.iter().find(same_name) {
            Some(new) if new.hash == old.hash => {}
            Some(new) => changes.push(format!(
                "{} is not the network that the run was made with: its BLAKE3 starts with {}, that of the run's with {}",
                new.file.display(),
                new.hash,
                old.hash
            )),
            None => changes.push(format!("the network {} that the run was made with is not used", words(old))),
        }
    }
    changes
}

/// The providers that answer clicks on a run: with the run's settings, and with the networks that `code` names.
///
/// # Errors
/// When the run was made with networks and `code` does not name them, or when a named file cannot be used.
pub fn providers_for(folder: &RunFolder, code: &Code) -> Result<Providers, RunError> {
    let mut settings = folder.settings()?;
    code.tell(&mut settings.vision);
    // A click does not need the network that finds transients.
    settings.vision.transient_network.clear();
    let networks = of_clicks(recorded(folder));
    code.names(&networks, &settings.vision)?;
    Ok(Providers::keeping(&vision_of_clicks(&settings), Some(Arc::new(InCache(folder.cache()?))))?)
}

/// The networks that clicks use.
pub(crate) fn of_clicks(mut networks: Vec<NetworkFile>) -> Vec<NetworkFile> {
    networks.retain(|network| network.setting != "transient_network");
    networks
}

/// The vision settings for clicks: the memory of the training's and the feature field's caches is free for the analyses
/// of photos.
fn vision_of_clicks(settings: &Settings) -> VisionSettings {
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
        let message = nothing.names_networks_of(&folder, &VisionSettings::default()).unwrap_err().to_string();
        for word in ["sam_encoder.onnx", "0123456789abcdef", "1 more", "--models FOLDER", "/nets)", MODELS] {
            assert!(message.contains(word), "{word}: {message}");
        }
        let without = Code { flags: [("models", String::new())].into(), ..Code::default() };
        without.names_networks_of(&folder, &VisionSettings::default()).unwrap();
        let mut named = VisionSettings::default();
        let environment = |folder: &str| BTreeMap::from([("models", folder.to_owned())]);
        Code { environment: environment("/elsewhere"), ..Code::default() }.tell(&mut named);
        assert_eq!(named.models, "/elsewhere");
        nothing.names_networks_of(&folder, &named).unwrap();
    }

    #[cfg(unix)]
    #[test]
    fn a_received_folder_whose_settings_are_a_pipe_or_an_endless_device_does_not_hang() {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::at(dir.path());
        let file = folder.settings_file();
        std::fs::write(&file, "[vision]\nmodels = \"/nets\"\n").unwrap();
        assert_eq!(recorded(&folder), [network("models", "/nets", "")]);
        std::fs::remove_file(&file).unwrap();
        std::os::unix::fs::symlink("/dev/zero", &file).unwrap();
        assert!(recorded(&folder).is_empty() && Settings::recorded(&file, &[]).is_err());
        std::fs::remove_file(&file).unwrap();
        assert!(std::process::Command::new("mkfifo").arg(&file).status().unwrap().success());
        assert!(recorded(&folder).is_empty() && Settings::recorded(&file, &[]).is_err());
    }

    #[test]
    fn a_network_with_other_bytes_under_the_same_name_is_reported() {
        let before = [network("models", "/a/sky.onnx", "01"), network("models", "/a/edges.onnx", "02")];
        let same = [network("models", "/b/sky.onnx", "01"), network("models", "/b/edges.onnx", "02")];
        assert!(changes(&before, &same).is_empty());
        let message = changes(&before, &[network("models", "/b/sky.onnx", "03")]).join("\n");
        assert!(
            message.contains("/b/sky.onnx is not the network")
                && message.contains("edges.onnx (BLAKE3 02..)"),
            "{message}"
        );
    }

    #[test]
    fn a_run_made_with_a_service_wants_its_address_again_wherever_it_is_now() {
        let dir = tempfile::tempdir().unwrap();
        let folder = RunFolder::create(dir.path()).unwrap();
        record(&folder, &[network("vision_service", "grpc://gpu:1", "01")]).unwrap();
        let message =
            Code::default().names_networks_of(&folder, &VisionSettings::default()).unwrap_err().to_string();
        assert!(message.contains("--vision-service grpc://HOST:PORT") && message.contains("grpc://gpu:1"));
        let elsewhere = [network("vision_service", "grpc://other:2", "01")];
        assert!(changes(&recorded(&folder), &elsewhere).is_empty());
        let other = [network("vision_service", "grpc://gpu:1", "02")];
        assert_eq!(changes(&recorded(&folder), &other).len(), 1);
    }

    #[test]
    fn a_flag_says_where_networks_are_before_the_environment_and_that_before_nothing() {
        let flags = [("models".to_owned(), "/flag".to_owned()), ("tau".to_owned(), "1".to_owned())];
        let environment = BTreeMap::from([("models", "/environment".to_owned())]);
        let code = Code { environment: environment.clone(), ..Code::given(&flags) };
        assert!(code.variables().any(|pair| pair == (MODELS, "/flag")));
        let mut settings = VisionSettings { models: "/file".into(), ..VisionSettings::default() };
        code.tell(&mut settings);
        assert_eq!(settings.models, "/flag");
        let code = Code { environment, ..Code::default() };
        settings.models = "/file".into();
        code.tell(&mut settings);
        assert_eq!(settings.models, "/file", "a settings file of the user's own");
    }

    #[test]
    fn every_setting_that_names_a_file_is_known_for_code_or_for_data() {
        use segwild_scene::settings::Group;
        // A new setting of free text must be put on one of the two lists.
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
