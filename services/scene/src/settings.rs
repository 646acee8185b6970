//! Settings, declared once: the command line, `segwild.toml` and the documentation are made from these structs.
//!
//! ```
//! segwild_scene::settings! {
//!     /// How long to train.
//!     pub struct TrainSettings("train", user: steps) {
//!         /// Optimiser steps.
//!         steps: u32 = 3000 => 1..=1_000_000,
//!     }
//! }
//! use segwild_scene::settings::Group;
//! let mut s = TrainSettings::default();
//! s.set("steps", "500").unwrap();
//! assert!(s.set("steps", "0").unwrap_err().to_string().contains("1 to 1000000"));
//! assert_eq!((s.steps, TrainSettings::FIELDS[0].doc), (500, "Optimiser steps."));
//! assert!(!TrainSettings::FIELDS[0].expert, "`user` names the settings that are not for experts alone");
//! ```

use std::fmt::Display;
use std::ops::{Bound, RangeBounds};

/// One setting, as help and documentation show it.
#[derive(Clone, Copy, Debug)]
pub struct Field {
    /// Name as in the struct and in `segwild.toml`; the flag has dashes for underscores.
    pub name: &'static str,
    /// Its effect, and its unit.
    pub doc: &'static str,
    /// What kind of value it takes.
    pub kind: &'static str,
    /// The accepted words, if it is a choice.
    pub choices: &'static [&'static str],
    /// What each of these words does, in their order; empty where they speak for themselves.
    pub choice_docs: &'static [&'static str],
    /// The accepted range, if not every number: `0 to 3`, `1 or more`.
    pub range: Option<fn() -> String>,
    /// Whether most users never need it: it is left out of the short help and stands on the second page of the reference.
    pub expert: bool,
}

impl Field {
    /// The accepted words with what each does; none where they speak for themselves.
    pub fn explained_choices(&self) -> impl Iterator<Item = (&'static str, &'static str)> {
        self.choices.iter().copied().zip(self.choice_docs.iter().copied())
    }
}

/// Whether a list of names holds one; at compile time, for [`settings!`](crate::settings!).
pub const fn holds(names: &[&str], name: &str) -> bool {
    let mut i = 0;
    while i < names.len() {
        if same(names[i].as_bytes(), name.as_bytes()) {
            return true;
        }
        i += 1;
    }
    false
}

const fn same(a: &[u8], b: &[u8]) -> bool {
    let mut i = 0;
    while i < a.len() && i < b.len() {
        if a[i] != b[i] {
            return false;
        }
        i += 1;
    }
    a.len() == b.len()
}

/// A range of numbers in words.
pub fn range_words<T: Display>(range: &impl RangeBounds<T>) -> String {
    let from = match range.start_bound() {
        Bound::Included(a) | Bound::Excluded(a) => a.to_string(),
        Bound::Unbounded => "any".into(),
    };
    match range.end_bound() {
        Bound::Included(b) => format!("{from} to {b}"),
        Bound::Excluded(b) => format!("{from} to less than {b}"),
        Bound::Unbounded => format!("{from} or more"),
    }
}

/// What a value is not.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum ValueError {
    /// It is no value of the setting's type, which is named.
    #[error("expected {0}")]
    Kind(&'static str),
    /// It is none of these words.
    #[error("expected one of {}", .0.join(", "))]
    Choice(&'static [&'static str]),
    /// It lies outside this range, as [`range_words`] names it.
    #[error("expected {0}")]
    Range(String),
}

/// Why a setting was refused.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
pub enum SettingError {
    /// No setting of that name.
    #[error("there is no setting named `{0}`")]
    Unknown(String),
    /// The name of an earlier version.
    #[error("there is no setting named `{name}`; it is now `{now}`")]
    Renamed {
        /// The earlier name.
        name: String,
        /// What the setting is called now.
        now: &'static str,
    },
    /// The value does not fit.
    #[error("`{value}` does not fit `{name}`: {reason}")]
    Value {
        /// The setting.
        name: String,
        /// What was given.
        value: String,
        /// What is wrong with it.
        reason: ValueError,
    },
}

/// A group of settings: one table of `segwild.toml`.
pub trait Group: Default {
    /// Name of the table.
    const TABLE: &'static str;
    /// What the group is about.
    const DOC: &'static str;
    /// Names of the settings that a user needs; the others are for experts.
    const USER: &'static [&'static str];
    /// The settings in order.
    const FIELDS: &'static [Field];
    /// Sets one by name from its text.
    fn set(&mut self, name: &str, value: &str) -> Result<(), SettingError>;
    /// The text of one.
    fn get(&self, name: &str) -> Option<String>;
    /// Refuses the first value outside its range; [`Group::set`] lets none in, but a struct's fields are open.
    fn check(&self) -> Result<(), SettingError> {
        let mut copy = Self::default();
        Self::FIELDS.iter().try_for_each(|f| copy.set(f.name, &self.get(f.name).unwrap_or_default()))
    }
}

/// A type a setting can have.
pub trait Value: Sized + Display {
    /// Shown in help: `N`, `X`, `WORD`.
    const KIND: &'static str;
    /// The words accepted, if it is a choice.
    const CHOICES: &'static [&'static str] = &[];
    /// What each of them does, in their order.
    const CHOICE_DOCS: &'static [&'static str] = &[];
    /// Reads the text a person typed.
    fn read(text: &str) -> Result<Self, ValueError>;
}

macro_rules! numbers {
    ($($t:ty => $kind:literal, $what:literal);*) => {$(
        impl Value for $t {
            const KIND: &'static str = $kind;
            fn read(text: &str) -> Result<Self, ValueError> {
                text.parse().map_err(|_| ValueError::Kind($what))
            }
        }
    )*};
}
numbers!(u32 => "N", "a whole number"; u64 => "N", "a whole number"; usize => "N", "a whole number");

impl Value for f32 {
    const KIND: &'static str = "X";
    fn read(text: &str) -> Result<Self, ValueError> {
        match text.parse::<f32>() {
            // A minus before a zero is lost where settings are written.
            Ok(x) if x.is_finite() => Ok(x + 0.0),
            _ => Err(ValueError::Kind("a finite number")),
        }
    }
}

impl Value for bool {
    const KIND: &'static str = "WORD";
    const CHOICES: &'static [&'static str] = &["true", "false"];
    fn read(text: &str) -> Result<Self, ValueError> {
        match text {
            "true" | "on" | "yes" => Ok(true),
            "false" | "off" | "no" => Ok(false),
            _ => Err(ValueError::Kind("true or false")),
        }
    }
}

impl Value for String {
    const KIND: &'static str = "TEXT";
    fn read(text: &str) -> Result<Self, ValueError> {
        Ok(text.to_owned())
    }
}

/// Declares a group of settings; see the module's example.
#[macro_export]
macro_rules! settings {
    (@range $ty:ty => $range:expr) => { Some(|| $crate::settings::range_words::<$ty>(&($range))) };
    (@range $ty:ty) => { None };
    ($(#[doc = $doc:literal])+ pub struct $name:ident($table:literal $(, user: $($user:ident)+)?) {
        $($(#[doc = $fdoc:literal])+ $field:ident : $ty:ty = $default:expr $(=> $range:expr)?,)*
    }) => {
        $(#[doc = $doc])+
        #[derive(Clone, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
        #[serde(default, deny_unknown_fields)]
        pub struct $name { $($(#[doc = $fdoc])+ pub $field: $ty,)* }

        impl Default for $name {
            fn default() -> Self { Self { $($field: $default,)* } }
        }

        // A name in `user` that is no setting does not compile.
        $(const _: fn(&$name) = |settings| { $(let _ = &settings.$user;)+ };)?

        impl $crate::settings::Group for $name {
            const TABLE: &'static str = $table;
            const DOC: &'static str = concat!($($doc,)+).trim_ascii_start();
            const USER: &'static [&'static str] = &[$($(stringify!($user)),+)?];
            const FIELDS: &'static [$crate::settings::Field] = &[$($crate::settings::Field {
                name: stringify!($field),
                doc: concat!($($fdoc,)+).trim_ascii_start(),
                kind: <$ty as $crate::settings::Value>::KIND,
                choices: <$ty as $crate::settings::Value>::CHOICES,
                choice_docs: <$ty as $crate::settings::Value>::CHOICE_DOCS,
                range: $crate::settings!(@range $ty $(=> $range)?),
                expert: !$crate::settings::holds(Self::USER, stringify!($field)),
            },)*];
            fn set(&mut self, name: &str, value: &str) -> Result<(), $crate::settings::SettingError> {
                match name {
                    $(stringify!($field) => {
                        let wrong = |reason: $crate::settings::ValueError| {
                            $crate::settings::SettingError::Value { name: name.into(), value: value.into(), reason }
                        };
                        let read = <$ty as $crate::settings::Value>::read(value).map_err(wrong)?;
                        $(if !std::ops::RangeBounds::<$ty>::contains(&($range), &read) {
                            let words = $crate::settings::range_words::<$ty>(&($range));
                            return Err(wrong($crate::settings::ValueError::Range(words)));
                        })?
                        self.$field = read;
                        Ok(())
                    })*
                    _ => Err($crate::settings::SettingError::Unknown(name.into())),
                }
            }
            fn get(&self, name: &str) -> Option<String> {
                match name { $(stringify!($field) => Some(self.$field.to_string()),)* _ => None }
            }
        }
    };
}

/// Declares a setting that is one of a few words.
///
/// ```
/// segwild_scene::choice! {
///     /// Which appearance model to train.
///     pub enum AppearanceKind {
///         /// No appearance model.
///         None = "none",
///         /// A colour matrix per photo.
///         Affine = "affine",
///     }
/// }
/// use segwild_scene::settings::Value;
/// assert!(matches!(AppearanceKind::read("affine"), Ok(AppearanceKind::Affine)));
/// assert_eq!(AppearanceKind::CHOICE_DOCS, ["No appearance model.", "A colour matrix per photo."]);
/// ```
#[macro_export]
macro_rules! choice {
    ($(#[$doc:meta])+ pub enum $name:ident { $($(#[doc = $vdoc:literal])+ $variant:ident = $word:literal),+ $(,)? }) => {
        $(#[$doc])+
        #[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, serde::Serialize, serde::Deserialize)]
        pub enum $name { $($(#[doc = $vdoc])+ #[serde(rename = $word)] $variant,)+ }

        impl std::fmt::Display for $name {
            fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                f.write_str(match self { $(Self::$variant => $word,)+ })
            }
        }

        impl $crate::settings::Value for $name {
            const KIND: &'static str = "WORD";
            const CHOICES: &'static [&'static str] = &[$($word),+];
            const CHOICE_DOCS: &'static [&'static str] = &[$(concat!($($vdoc),+).trim_ascii_start()),+];
            fn read(text: &str) -> Result<Self, $crate::settings::ValueError> {
                match text {
                    $($word => Ok(Self::$variant),)+
                    _ => Err($crate::settings::ValueError::Choice(Self::CHOICES)),
                }
            }
        }
    };
}
