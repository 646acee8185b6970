//! A time that a person sets, as `10m` or `1h30m`.

use crate::settings::{Value, ValueError};
use serde::{Deserialize, Deserializer, Serialize, Serializer};
use std::fmt;

/// The longest that is accepted, in hours.
const LONGEST: u32 = 1000;
/// What a text should be.
const EXPECTED: &str = "a time with its units, as 90s, 10m, 2h or 1h30m; 0 is none";
/// Units in the order in which they are written, with their seconds.
const UNITS: [(char, u32); 3] = [('h', 3600), ('m', 60), ('s', 1)];

/// A time in whole seconds; 0 is none.
///
/// ```
/// use segwild_scene::WallTime;
/// use segwild_scene::settings::Value;
/// let time = WallTime::read("1h30m")?;
/// assert_eq!((time.seconds(), time.to_string().as_str()), (5400, "1h30m"));
/// assert!(WallTime::read("10").is_err(), "a number without a unit is no time");
/// # Ok::<_, segwild_scene::settings::ValueError>(())
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct WallTime(u32);

impl WallTime {
    /// So many seconds; at most 1000 hours.
    pub fn of(seconds: u32) -> WallTime {
        WallTime(seconds.min(LONGEST * 3600))
    }

    /// The next time that a person would write: in steps of 10 s up to 10 minutes, then of a minute.
    pub fn rounded_up(seconds: f64) -> WallTime {
        let step = if seconds <= 600.0 { 10.0 } else { 60.0 };
        // A cast of what is too large, or no number, saturates.
        WallTime::of(((seconds / step).ceil() * step).max(step) as u32)
    }

    /// The same in seconds.
    pub fn seconds(self) -> u32 {
        self.0
    }

    /// Whether there is none.
    pub fn is_none(self) -> bool {
        self.0 == 0
    }
}

impl fmt::Display for WallTime {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        if self.is_none() {
            return f.write_str("0");
        }
        let mut rest = self.0;
        for (unit, seconds) in UNITS {
            if rest >= seconds {
                write!(f, "{}{unit}", rest / seconds)?;
            }
            rest %= seconds;
        }
        Ok(())
    }
}

impl Value for WallTime {
    const KIND: &'static str = "TIME";
    fn read(text: &str) -> Result<WallTime, ValueError> {
        if text == "0" {
            return Ok(WallTime(0));
        }
        let wrong = || ValueError::Kind(EXPECTED);
        // Larger units come first, each once.
        let (mut rest, mut sum, mut units) = (text, 0u64, UNITS.iter());
        while !rest.is_empty() {
            let digits = rest.find(|c: char| !c.is_ascii_digit()).ok_or_else(wrong)?;
            let (number, after) = rest.split_at(digits);
            let unit = after.chars().next().ok_or_else(wrong)?;
            let (_, seconds) = units.find(|(letter, _)| *letter == unit).ok_or_else(wrong)?;
            let number: u32 = number.parse().map_err(|_| wrong())?;
            sum += u64::from(number) * u64::from(*seconds);
            rest = &after[unit.len_utf8()..];
        }
        if text.is_empty() {
            return Err(wrong());
        }
        match u32::try_from(sum) {
            Ok(seconds) if seconds <= LONGEST * 3600 => Ok(WallTime(seconds)),
            _ => Err(ValueError::Range(format!("at most {LONGEST}h"))),
        }
    }
}

/// As a person writes it.
impl Serialize for WallTime {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        serializer.collect_str(self)
    }
}

impl<'de> Deserialize<'de> for WallTime {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<WallTime, D::Error> {
        let text = String::deserialize(deserializer)?;
        WallTime::read(&text).map_err(serde::de::Error::custom)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_person_writes_is_read_and_written_the_same() {
        let cases = [("0", 0), ("90s", 90), ("10m", 600), ("2h", 7200), ("1h30m", 5400), ("1h0m5s", 3605)];
        for (text, seconds) in cases {
            let time = WallTime::read(text).expect(text);
            assert_eq!(time.seconds(), seconds, "{text}");
            assert_eq!(WallTime::read(&time.to_string()), Ok(time), "{text}");
        }
        assert_eq!(WallTime::of(90).to_string(), "1m30s");
        assert_eq!(WallTime::of(3600).to_string(), "1h");
    }

    #[test]
    fn what_is_no_time_is_refused_in_words() {
        for wrong in ["", "10", "m", "ten", "10m5", "5s10m", "1m1m", "-5m", "1.5h", "99999999999s", "3ü"] {
            let words = WallTime::read(wrong).expect_err(wrong).to_string();
            assert!(words.contains("90s, 10m, 2h or 1h30m"), "{wrong}: {words}");
        }
        for long in ["1001h", "4294967295h", "4000000s"] {
            assert_eq!(WallTime::read(long).expect_err(long).to_string(), "expected at most 1000h");
        }
    }

    #[test]
    fn times_are_rounded_up_to_what_a_person_would_write() {
        let rounded = |seconds| WallTime::rounded_up(seconds).to_string();
        assert_eq!([0.2, 61.0, 600.0, 601.0].map(rounded), ["10s", "1m10s", "10m", "11m"]);
        assert_eq!(rounded(f64::INFINITY), "1000h");
    }
}
