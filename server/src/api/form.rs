//! Observations as forms, for people with curl: `-F step=0 -F image=@frame.png -F action=0,0.5 -F outputs=objects`.

use axum::{
    extract::multipart::{Field, Multipart, MultipartError},
    http::StatusCode,
};
use gatsbi_proto::v1::{self, image::Content};

use crate::error::Error;

/// Why a form is no observation.
#[derive(Debug)]
pub(super) enum FormError {
    /// The body is too large.
    TooLarge,
    /// Something in it is wrong.
    Wrong(Error),
}

impl From<MultipartError> for FormError {
    fn from(error: MultipartError) -> Self {
        if error.status() == StatusCode::PAYLOAD_TOO_LARGE {
            return Self::TooLarge;
        }
        let message = "multipart form".to_owned();
        Self::Wrong(Error::Malformed { message, reason: error.body_text() })
    }
}

/// Reads the fields `step`, `image`, `action`, `outputs`, `encoding` and `timeout_millis`, all but the first
/// optional. Lists are separated by commas; outputs and encodings may leave out their prefix and be lower case.
pub(super) async fn observation(mut form: Multipart) -> Result<v1::ObserveRequest, FormError> {
    let mut observation = v1::Observation::default();
    let mut outputs = v1::OutputSelection::default();
    let mut timeout_millis = None;
    while let Some(field) = form.next_field().await? {
        let name = field.name().unwrap_or_default().to_owned();
        match name.as_str() {
            "image" => {
                let content = Some(Content::Encoded(field.bytes().await?));
                observation.image = Some(v1::Image { content });
            }
            "step" => observation.step = Some(number(field, "observation.step").await?),
            "timeout_millis" => timeout_millis = Some(number(field, "timeout_millis").await?),
            "action" => {
                for (at, part) in parts(&field.text().await?).enumerate() {
                    let field = format!("observation.action[{at}]");
                    observation.action.push(parse(part, &field, "a number")?);
                }
            }
            "outputs" => {
                for (at, part) in parts(&field.text().await?).enumerate() {
                    let output = v1::Output::from_str_name(&full(part, "OUTPUT_"));
                    let output = output.ok_or_else(|| {
                        let field = format!("outputs.outputs[{at}]");
                        FormError::Wrong(Error::invalid(field, part, "the name of an output"))
                    })?;
                    outputs.outputs.push(output.into());
                }
            }
            "encoding" => {
                let text = field.text().await?;
                let encoding = v1::Encoding::from_str_name(&full(&text, "ENCODING_"));
                let encoding = encoding.ok_or_else(|| {
                    let expected = "the name of an encoding";
                    FormError::Wrong(Error::invalid("outputs.encoding", &text, expected))
                })?;
                outputs.encoding = encoding.into();
            }
            _ => {
                let expected = "step, image, action, outputs, encoding or timeout_millis";
                return Err(FormError::Wrong(Error::invalid(name, "a field", expected)));
            }
        }
    }
    Ok(v1::ObserveRequest {
        session_id: String::new(),
        observation: Some(observation),
        outputs: Some(outputs),
        timeout_millis,
    })
}

async fn number<T: std::str::FromStr>(field: Field<'_>, name: &str) -> Result<T, FormError> {
    parse(field.text().await?.trim(), name, "a whole number")
}

fn parse<T: std::str::FromStr>(text: &str, field: &str, expected: &str) -> Result<T, FormError> {
    let wrong = || FormError::Wrong(Error::invalid(field, format!("{text:?}"), expected));
    text.parse().ok().ok_or_else(wrong)
}

fn parts(text: &str) -> impl Iterator<Item = &str> {
    let list = text.trim().trim_start_matches('[').trim_end_matches(']');
    list.split(',').map(str::trim).filter(|part| !part.is_empty())
}

/// The full name of an enum value.
fn full(text: &str, prefix: &str) -> String {
    let text = text.trim().to_ascii_uppercase();
    if text.starts_with(prefix) { text } else { format!("{prefix}{text}") }
}
