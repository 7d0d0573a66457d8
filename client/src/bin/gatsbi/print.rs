//! Output: tables for people, messages of `gatsbi.v1` as JSON for machines, and bars in a terminal.

use std::{
    io::{self, IsTerminal as _, Write as _},
    time::SystemTime,
};

use anyhow::Context as _;
use comfy_table::{CellAlignment, Table, presets::NOTHING};
use gatsbi_client::{Object, Timing, proto::FILE_DESCRIPTOR_SET};
use indicatif::{ProgressBar, ProgressStyle};
use prost::{Message, Name};
use prost_reflect::{DescriptorPool, DynamicMessage, SerializeOptions};

/// Prints to standard output; a reader that has seen enough, such as `head`, is no failure.
pub(crate) fn print(text: &str) -> anyhow::Result<()> {
    match io::stdout().write_all(text.as_bytes()) {
        Err(e) if e.kind() == io::ErrorKind::BrokenPipe => Ok(()),
        written => written.context("standard output"),
    }
}

/// Prints a line of JSON.
pub(crate) fn print_json(value: &serde_json::Value) -> anyhow::Result<()> {
    print(&format!("{value}\n"))
}

/// A message as the JSON that the REST API gives: the fields' own names, 64-bit integers as numbers, nothing left out.
pub(crate) fn json<M: Message + Name>(message: &M) -> anyhow::Result<serde_json::Value> {
    let pool = DescriptorPool::decode(FILE_DESCRIPTOR_SET).context("descriptors of gatsbi.v1")?;
    let descriptor = pool.get_message_by_name(&M::full_name()).context(M::NAME)?;
    let mut dynamic = DynamicMessage::new(descriptor);
    dynamic.transcode_from(message)?;
    let options = SerializeOptions::new()
        .stringify_64_bit_integers(false)
        .use_proto_field_name(true)
        .skip_default_fields(false);
    Ok(dynamic.serialize_with_options(serde_json::value::Serializer, &options)?)
}

/// A table of columns; those whose title begins with `<` stand to the left, numbers to the right.
pub(crate) fn table(titles: &[&str], rows: impl IntoIterator<Item = Vec<String>>) -> String {
    let mut table = Table::new();
    table.load_style(NOTHING).set_header(titles.iter().map(|title| title.trim_start_matches('<')));
    for (column, title) in table.column_iter_mut().zip(titles) {
        let left = title.starts_with('<');
        column.set_padding((0, 2));
        column.set_cell_alignment(if left { CellAlignment::Left } else { CellAlignment::Right });
    }
    table.add_rows(rows);
    trimmed(&table)
}

/// Names and values, one pair a line.
pub(crate) fn pairs<'a>(pairs: impl IntoIterator<Item = (&'a str, String)>) -> String {
    let mut table = Table::new();
    table.load_style(NOTHING);
    table.add_rows(pairs.into_iter().map(|(name, value)| [name.to_owned(), value]));
    for column in table.column_iter_mut() {
        column.set_padding((0, 2));
    }
    trimmed(&table)
}

/// Objects that are there more surely than not.
pub(crate) fn objects<'a>(objects: impl IntoIterator<Item = &'a Object>) -> String {
    let titles =
        ["id", "slot", "presence", "x", "y", "width", "height", "depth", "pixel x", "pixel y"];
    let rows = objects.into_iter().map(|o| {
        let two = |number: f32| format!("{number:.2}");
        let pixel = |number: f32| format!("{number:.1}");
        let mut row = vec![o.id.to_string(), o.slot.to_string()];
        row.extend([o.presence, o.x, o.y, o.width, o.height, o.depth].map(two));
        row.extend([o.pixel_x, o.pixel_y].map(pixel));
        row
    });
    table(&titles, rows)
}

/// Queue, compute and encode in milliseconds.
pub(crate) fn timing(timing: &Timing) -> [String; 3] {
    let Timing { queue_micros, compute_micros, encode_micros } = *timing;
    [queue_micros, compute_micros, encode_micros]
        .map(|micros| format!("{:.1}", f64::from(micros) / 1e3))
}

/// A point in time as seconds ago or ahead.
pub(crate) fn from_now(time: SystemTime) -> String {
    match time.duration_since(SystemTime::now()) {
        Ok(ahead) => format!("in {} s", ahead.as_secs()),
        Err(passed) => format!("{} s ago", passed.duration().as_secs()),
    }
}

/// A bar in a terminal, nothing otherwise or where machines read.
pub(crate) fn bar(length: usize, what: &'static str, json: bool) -> ProgressBar {
    if json || !io::stderr().is_terminal() {
        return ProgressBar::hidden();
    }
    let style = ProgressStyle::with_template("{bar:40} {pos}/{len} {msg}, {eta} left")
        .unwrap_or_else(|_| ProgressStyle::default_bar());
    ProgressBar::new(length as u64).with_style(style).with_message(what)
}

fn trimmed(table: &Table) -> String {
    let mut text = String::new();
    for line in table.lines() {
        text.push_str(line.trim_end());
        text.push('\n');
    }
    text
}

#[cfg(test)]
mod tests {
    use gatsbi_client::SessionInfo;

    use super::*;

    #[test]
    fn numbers_stand_under_their_titles() {
        let rows = [vec!["7".into(), "b".into()], vec!["12".into(), "c".into()]];
        assert_eq!(table(&["id", "<name"], rows), "id  name\n 7  b\n12  c\n");
    }

    #[test]
    fn messages_keep_the_names_of_the_wire() {
        let session = SessionInfo { id: "a".into(), seed: 1 << 52, ..SessionInfo::default() };
        let value = json(&session).unwrap();
        assert_eq!((&value["seed"], &value["next_step"]), (&(1u64 << 52).into(), &0.into()));
        assert_eq!(value["mode"], "MODE_UNSPECIFIED");
    }
}
