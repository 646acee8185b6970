//! The worst answer of each object, and the file of its image.

use segwild_eval::record::Record;

/// The file of an object's image, in the folder of the results.
pub fn image_of(scene: &str, object: &str, size: f64) -> String {
    format!("worst-{scene}-{object}-{size}.png")
}

/// Of each object its worst prompt, in order of the records.
pub fn worst<'a>(records: &[&'a Record]) -> Vec<&'a Record> {
    let iou = |r: &Record| r.numbers.get("iou").copied().unwrap_or(0.0);
    let mut worst: Vec<&Record> = Vec::new();
    for r in records {
        match worst.iter_mut().find(|w| w.scene == r.scene && w.target == r.target) {
            Some(known) if iou(r) < iou(known) => *known = r,
            Some(_) => {}
            None => worst.push(r),
        }
    }
    worst
}

#[cfg(test)]
mod tests {
    use super::*;

    fn record(object: &str, prompt: u32, iou: f64) -> Record {
        Record {
            scene: "square".into(),
            target: object.into(),
            prompt,
            numbers: [("iou".to_owned(), iou)].into(),
            ..Record::default()
        }
    }

    #[test]
    fn each_object_has_its_worst_prompt() {
        let records = [record("a", 0, 0.5), record("b", 0, 0.9), record("a", 1, 0.2), record("a", 2, 0.2)];
        let found: Vec<(&str, u32)> = worst(&records.iter().collect::<Vec<_>>())
            .iter()
            .map(|r| (r.target.as_str(), r.prompt))
            .collect();
        assert_eq!(found, [("a", 1), ("b", 0)]);
    }
}
